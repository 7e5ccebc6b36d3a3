# The serving image, run as an unprivileged user on a read-only file system; `--target tools`: also load tests and reports.
#
# Pin the base image to the hash that you have reviewed:
#   --build-arg PYTHON_IMAGE=python:3.11-slim@sha256:…   (docker buildx imagetools inspect python:3.11-slim)
# For a GPU node (deploy/kubernetes/overlays/gpu): --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cu126
ARG PYTHON_IMAGE=python:3.11-slim
FROM ${PYTHON_IMAGE} AS build
# The CPU build of torch; the default build adds gigabytes of CUDA libraries
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
WORKDIR /src
RUN python -m venv /opt/cab-forecast
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY proto proto
COPY model model
COPY service service
COPY cli cli
COPY cab_forecast cab_forecast
COPY benchmark benchmark
RUN /opt/cab-forecast/bin/pip install --no-cache-dir --disable-pip-version-check \
      --extra-index-url ${TORCH_INDEX} -c constraints.txt .

FROM build AS build-tools
RUN /opt/cab-forecast/bin/pip install --no-cache-dir --disable-pip-version-check \
      --extra-index-url ${TORCH_INDEX} -c constraints.txt ".[plot]" psutil

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
