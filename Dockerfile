# The serving image, run as an unprivileged user on a read-only file system; `--target tools`: also load tests and reports.
#
# Pin the base image to the hash that you have reviewed:
#   --build-arg PYTHON_IMAGE=python:3.11-slim@sha256:…   (docker buildx imagetools inspect python:3.11-slim)
# Pin torch likewise: --build-arg TORCH_HASH=--hash=sha256:…
# Extras: --build-arg EXTRAS=[record,tracing]
# For a GPU node (deploy/kubernetes/overlays/gpu), whose torch needs CUDA libraries from the same index:
#   --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu126 --build-arg TORCH_FLAGS=
ARG PYTHON_IMAGE=python:3.11-slim
FROM ${PYTHON_IMAGE} AS build
# The CPU build of torch; the default build adds gigabytes of CUDA libraries
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
ARG TORCH_HASH=""
ARG TORCH_FLAGS="--no-deps"
WORKDIR /src
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
RUN python -m venv /opt/cab-forecast
COPY constraints.txt requirements-image.txt ./
# pip refuses an archive whose hash is not in the file, which `make lock` writes
RUN /opt/cab-forecast/bin/pip download --only-binary :all: --no-deps --require-hashes -r requirements-image.txt -d /wheels \
 && echo "$(grep '^torch==' constraints.txt) ${TORCH_HASH}" > torch.txt \
 && /opt/cab-forecast/bin/pip download --only-binary :all: ${TORCH_FLAGS} --index-url ${TORCH_INDEX} -r torch.txt -d /wheels
COPY pyproject.toml README.md LICENSE ./
COPY proto proto
COPY model model
COPY service service
COPY cli cli
COPY cab_forecast cab_forecast
COPY benchmark benchmark
# Nothing comes from an index here. torch's headers and tests are of no use to a server; of its programs it looks for one
ARG EXTRAS=""
RUN /opt/cab-forecast/bin/pip install --no-index --find-links /wheels -c constraints.txt ".${EXTRAS}" \
 && cd /opt/cab-forecast/lib/python3*/site-packages/torch && rm -rf include test \
 && find bin -mindepth 1 ! -name torch_shm_manager -delete

FROM build AS build-tools
RUN /opt/cab-forecast/bin/pip install --no-index --find-links /wheels -c constraints.txt ".[plot]" psutil

FROM ${PYTHON_IMAGE} AS base
RUN useradd --system --uid 10001 --no-create-home forecast
ENV PATH=/opt/cab-forecast/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    ORT_DISABLE_TELEMETRY=1
USER 10001

FROM base AS tools
COPY --from=build-tools /opt/cab-forecast /opt/cab-forecast
COPY loadtest /opt/tools/loadtest
WORKDIR /opt/tools
CMD ["cab-forecast", "--help"]

# The last stage is what is built without --target
FROM base
COPY --from=build /opt/cab-forecast /opt/cab-forecast
ENV FORECAST_HTTP=0.0.0.0:8080 \
    FORECAST_GRPC=0.0.0.0:50051 \
    FORECAST_PROBES=127.0.0.1:8081 \
    FORECAST_LOG_JSON=true
# The revision of the source, which GetVersion and forecast_build_info tell
ARG REVISION=""
ENV FORECAST_REVISION=$REVISION
# It listens on all addresses, so it starts only with keys, or if it is told to allow anyone: see docs/security.md
EXPOSE 8080 50051
# The proxies of the environment are not asked for this address
HEALTHCHECK --interval=10s --timeout=5s --start-period=30s \
  CMD ["python", "-c", "import http.client; c = http.client.HTTPConnection('127.0.0.1:8081', timeout=4); c.request('GET', '/readyz'); raise SystemExit(c.getresponse().status != 200)"]
# On SIGTERM the server drains and stops
CMD ["cab-forecast", "serve"]
