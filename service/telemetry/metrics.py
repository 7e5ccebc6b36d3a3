"""Prometheus metrics. Every server object has its own registry, so that tests can run many."""

from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter

from prometheus_client import (
    CollectorRegistry,
    Counter,
    Gauge,
    GCCollector,
    Histogram,
    PlatformCollector,
    ProcessCollector,
    generate_latest,
)

from model.forecaster import ModelInfo, Protocol

_SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_AGENTS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)


class Metrics:
    """All metrics of one server. Labels are names from fixed, small sets; never ids."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        ProcessCollector(registry=self.registry)
        PlatformCollector(registry=self.registry)
        GCCollector(registry=self.registry)
        self.requests = Counter(
            "forecast_requests_total",
            "Calls by transport, method and canonical status code.",
            ["transport", "method", "code"],
            registry=self.registry,
        )
        self.request_duration = Histogram(
            "forecast_request_duration_seconds",
            "Calls from their arrival to their answer.",
            ["transport", "method"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.queue = Histogram(
            "forecast_queue_seconds",
            "Waiting for the model to be free.",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.inference = Histogram(
            "forecast_inference_seconds",
            "One batch inside the model.",
            ["model"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.batch_agents = Histogram(
            "forecast_batch_agents",
            "Agents in a batch, of all calls that rode in it.",
            buckets=_AGENTS,
            registry=self.registry,
        )
        self.agents = Counter(
            "forecast_agents_total",
            "Agents of answered calls, by the model that was asked for and what became of them.",
            ["model", "status"],
            registry=self.registry,
        )
        self.off_road = Counter(
            "forecast_off_road_total",
            "Forecasts whose most likely trajectory leaves the driveable area of the scene's raster.",
            ["model"],
            registry=self.registry,
        )
        self.nonfinite = Counter(
            "forecast_nonfinite_total",
            "Forecasts thrown away because the model gave a number that is not finite.",
            ["model"],
            registry=self.registry,
        )
        self.queue_agents = Gauge(
            "forecast_queue_agents",
            "Agents accepted that are not in the model yet.",
            registry=self.registry,
        )
        self.model_info = Gauge(
            "forecast_model_info",
            "1 for each model that is loaded.",
            ["name", "version", "protocol", "default"],
            registry=self.registry,
        )
        self.benchmark = Gauge(
            "forecast_benchmark_displacement_error_meters",
            "What the benchmark measured of forecast_displacement_error_meters, on average.",
            ["model", "horizon"],
            registry=self.registry,
        )

    def set_models(self, infos: list[ModelInfo], default: ModelInfo) -> None:
        """Says which models are loaded, and what the benchmark measured of them.

        Args:
            infos: all, of one name the oldest first.
            default: one of them.
        """
        for info in infos:
            is_default = "true" if info == default else "false"
            self.model_info.labels(info.name, info.version, info.protocol.value, is_default).set(1)
            # A series that began with its first event would hide it: nothing has increased since
            self.nonfinite.labels(info.name)
        for info in _by_name(infos, default).values():
            for seconds in range(1, int(info.horizon) + 1):
                error_m = info.benchmark.get(f"fde_ml_{seconds}s_m")
                if error_m is not None:
                    self.benchmark.labels(info.name, f"{seconds}").set(error_m)

    @contextmanager
    def call(self, transport: str, method: str, timed: bool = True) -> Iterator["Call"]:
        """Counts one call and times it; its code is what the caller of this puts into it.

        Args:
            transport: "grpc" or "rest".
            method: of the contract.
            timed: False for one that lasts as long as the client likes.
        """
        call = Call()
        started = perf_counter()
        try:
            yield call
        finally:
            self.requests.labels(transport, method, call.code).inc()
            if timed:
                self.request_duration.labels(transport, method).observe(perf_counter() - started)

    def render(self) -> bytes:
        """The text that Prometheus reads."""
        return generate_latest(self.registry)


def _by_name(infos: list[ModelInfo], default: ModelInfo) -> dict[str, ModelInfo]:
    """Of each name the version that is meant where none is given: the default, or the newest causal one, or
    the newest."""
    causal_last = sorted(infos, key=lambda info: info.protocol is Protocol.CAUSAL)
    return {info.name: info for info in [*causal_last, default]}


class Call:
    """How a call ended."""

    def __init__(self) -> None:
        self.code = "CANCELLED"
        """Canonical status code; stays as it is when the client goes away first."""
