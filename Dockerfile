# The serving image: the dependencies of pyproject.toml without extras, run as an unprivileged user.
FROM python:3.11-slim AS build
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY proto proto
COPY model model
COPY service service
COPY cli cli
COPY cab_forecast cab_forecast
COPY benchmark benchmark
# For example [record], with the brackets: extras of pyproject.toml that the server is to have
ARG EXTRAS=""
# The CPU build of torch; the default build adds gigabytes of CUDA libraries
RUN python -m venv /opt/cab-forecast \
 && /opt/cab-forecast/bin/pip install --no-cache-dir --disable-pip-version-check \
      --extra-index-url https://download.pytorch.org/whl/cpu -c constraints.txt ".${EXTRAS}"

FROM python:3.11-slim
RUN useradd --system --uid 10001 --no-create-home forecast
COPY --from=build /opt/cab-forecast /opt/cab-forecast
ENV PATH=/opt/cab-forecast/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    FORECAST_HTTP=0.0.0.0:8080 \
    FORECAST_GRPC=0.0.0.0:50051 \
    FORECAST_PROBES=127.0.0.1:8081 \
    FORECAST_LOG_JSON=true
# The revision of the source, which GetVersion and forecast_build_info tell
ARG REVISION=""
ENV FORECAST_REVISION=$REVISION
# It listens on all addresses, so it starts only with keys, or if it is told to allow anyone: see docs/security.md
USER 10001
EXPOSE 8080 50051
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s \
  CMD ["python", "-c", "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8081/readyz', timeout=2)"]
# On SIGTERM the server drains and stops
CMD ["cab-forecast", "serve"]
