"""Prometheus metrics. Each server object has its own registry, so that one process can run several."""

import collections
import dataclasses
from collections.abc import Iterable, Iterator
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
from prometheus_client.exposition import choose_encoder

from cab.forecast.v1.prediction_service_pb2 import ForecastStatus
from model.forecaster import ModelInfo, Protocol
from service.telemetry.build import Build
from service.telemetry.key_metrics import KeyMetrics

_SECONDS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
FORECAST_STATUSES = {
    number: name.removeprefix("FORECAST_STATUS_").lower() for name, number in ForecastStatus.items() if number
}
"""Names of the statuses of agents, as metrics give them, by number."""
_AGENTS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)


class Metrics:
    """Metrics of one server. Label values come from small, fixed sets; they are never ids."""

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
        self.build = Gauge(
            "forecast_build_info",
            "1, with the versions of the server and of what it runs on.",
            [field.name for field in dataclasses.fields(Build)],
            registry=self.registry,
        )
        self.request_duration = Histogram(
            "forecast_request_duration_seconds",
            "Duration of calls from arrival to response.",
            ["transport", "method"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.queue = Histogram(
            "forecast_queue_seconds",
            "Time that jobs wait in the queue until the model is free.",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.turn = Histogram(
            "forecast_turn_seconds",
            "Time that accepted calls wait for their turn, before features are made of them.",
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.inference = Histogram(
            "forecast_inference_seconds",
            "Duration of one batch in the model.",
            ["model"],
            buckets=_SECONDS,
            registry=self.registry,
        )
        self.batch_agents = Histogram(
            "forecast_batch_agents",
            "Agents per batch, over all calls in it.",
            buckets=_AGENTS,
            registry=self.registry,
        )
        self.workers = Gauge(
            "forecast_workers",
            "Processes that run forwards; while one is replaced, the server's process runs its forwards.",
            registry=self.registry,
        )
        self.worker_deaths = Counter(
            "forecast_worker_deaths_total",
            "Processes that ran forwards and died; the calls of the batch that they held failed.",
            registry=self.registry,
        )
        self.batches = Counter(
            "forecast_batches_total",
            "Batches by the reason why they have no more agents: no others waited that could join (empty), "
            "or with more they would have exceeded the max number (agents), would have taken too long "
            "(time), or a call in them would have been late (deadline).",
            ["reason"],
            registry=self.registry,
        )
        for departure in ("empty", "agents", "time", "deadline"):
            self.batches.labels(departure)
        self.agents = Counter(
            "forecast_agents_total",
            "Agents of answered calls, by requested model and status; the shadow's under name@version.",
            ["model", "status"],
            registry=self.registry,
        )
        self.off_road = Counter(
            "forecast_off_road_total",
            "Forecasts whose most likely trajectory leaves the driveable area of the scene's raster.",
            ["model"],
            registry=self.registry,
        )
        self.input_warnings = Counter(
            "forecast_input_warnings_total",
            "Forecasts with a warning that the agent's input contradicts itself, by the warning's code.",
            ["code"],
            registry=self.registry,
        )
        self.nonfinite = Counter(
            "forecast_nonfinite_total",
            "Forecasts discarded because the model returned a non-finite number.",
            ["model"],
            registry=self.registry,
        )
        self.queue_agents = Gauge(
            "forecast_queue_agents",
            "Accepted agents that wait in the queue.",
            registry=self.registry,
        )
        self.refused = Counter(
            "forecast_refused_total",
            "Calls refused as overload: the queue was full, the forecast would have been late, or there were "
            "too many calls, bytes of bodies or watchers; and calls that left the queue because they had "
            "become late (dropped) or calls of a higher priority had filled it (displaced).",
            ["reason"],
            registry=self.registry,
        )
        for reason in ("queue_full", "late", "dropped", "displaced", "concurrency", "bytes", "watchers"):
            self.refused.labels(reason)
        self.watchers = Gauge(
            "forecast_watchers",
            "Open streams of events by method.",
            ["method"],
            registry=self.registry,
        )
        for method in ("WatchScene", "WatchForecasts"):
            self.watchers.labels(method)
        self.frames = Counter(
            "forecast_frames_total",
            "Frames made for watchers of scenes.",
            registry=self.registry,
        )
        self.frames_dropped = Counter(
            "forecast_frames_dropped_total",
            "Frames that watchers of scenes did not get: a watcher read too slowly (watcher, counted for "
            "each), frames were asked for faster than they are made (busy), or Redis was too slow to bring "
            "them to other servers (redis).",
            ["reason"],
            registry=self.registry,
        )
        for cause in ("watcher", "busy", "redis"):
            self.frames_dropped.labels(cause)
        self.keys = KeyMetrics(self.registry)
        self.broken_files = Gauge(
            "forecast_broken_files",
            "1 while changed files of keys or certificates cannot be read, so the former ones are in use.",
            ["files"],
            registry=self.registry,
        )
        for files in ("keys", "certificates"):
            self.broken_files.labels(files)
        self.raster_lookups = Counter(
            "forecast_raster_lookups_total",
            "Scene rasters with a digest by where they came from: sent whole; named by the digest alone and "
            "found in memory or in Redis; or unknown.",
            ["source"],
            registry=self.registry,
        )
        for source in ("sent", "memory", "redis", "unknown"):
            self.raster_lookups.labels(source)
        self.raster_bytes = Gauge(
            "forecast_raster_bytes",
            "Size of the decoded scene rasters that are kept in memory.",
            registry=self.registry,
        )
        self.rasters_dropped = Counter(
            "forecast_rasters_dropped_total",
            "Scene rasters dropped from memory to make room for others.",
            registry=self.registry,
        )
        self.recording = Gauge(
            "forecast_recording",
            "1 while answered calls are recorded, 0 while they are not.",
            registry=self.registry,
        )
        self.recorded_calls = Counter(
            "forecast_recorded_calls_total",
            "Answered calls drawn for the recording, by what became of them there.",
            ["result"],
            registry=self.registry,
        )
        for result in ("written", "queue_full", "disk_full", "too_large", "failed"):
            self.recorded_calls.labels(result)
        self.model_info = Gauge(
            "forecast_model_info",
            "1 for each loaded model.",
            ["name", "version", "protocol", "default"],
            registry=self.registry,
        )
        self.shadow_calls = Counter(
            "forecast_shadow_calls_total",
            "Calls for the shadow model: done, dropped because models were busy, or failed.",
            ["model", "result"],
            registry=self.registry,
        )
        self.reloads = Counter(
            "forecast_model_reloads_total",
            "Reloads of the models while the server ran: with changes, without, or with models refused.",
            ["result"],
            registry=self.registry,
        )
        for result in ("changed", "unchanged", "refused"):
            self.reloads.labels(result)
        self.benchmark = Gauge(
            "forecast_benchmark_displacement_error_meters",
            "Mean of forecast_displacement_error_meters in the benchmark.",
            ["model", "horizon"],
            registry=self.registry,
        )

    def set_models(self, infos: list[ModelInfo], default: ModelInfo) -> None:
        """Set the metrics of the loaded models and their benchmark errors.

        Args:
            infos: all models; the versions of one name ascend.
            default: the default model.
        """
        self.model_info.clear()
        self.benchmark.clear()
        for info in infos:
            is_default = "true" if info == default else "false"
            self.model_info.labels(info.name, info.version, info.protocol.value, is_default).set(1)
            # Start at 0: rate() and increase() would miss the first event of a series that begins with it
            self.nonfinite.labels(info.name)
            self.off_road.labels(info.name)
            for status in FORECAST_STATUSES.values():
                self.agents.labels(info.name, status)
        for info in _by_name(infos, default).values():
            for seconds in range(1, int(info.horizon) + 1):
                error_m = info.benchmark.get(f"fde_ml_{seconds}s_m")
                if error_m is not None:
                    self.benchmark.labels(info.name, f"{seconds}").set(error_m)

    def count_agents(self, model: str, statuses: "Iterable[ForecastStatus.ValueType]") -> None:
        """Count the agents of a call.

        Args:
            model: label of the model.
            statuses: status of each agent.
        """
        for status, count in collections.Counter(statuses).items():
            self.agents.labels(model, FORECAST_STATUSES[status]).inc(count)

    def set_build(self, build: Build) -> None:
        """Set the metric of the build."""
        self.build.labels(**dataclasses.asdict(build)).set(1)

    def begin_calls(self, transport: str, method: str, codes: Iterable[str]) -> None:
        """Start the counters of a method at 0, for each code that its calls can end with."""
        for code in codes:
            self.requests.labels(transport, method, code)

    def begin_input_warnings(self, codes: Iterable[str]) -> None:
        """Start the counters of warnings of the input at 0, for each code."""
        for code in codes:
            self.input_warnings.labels(code)

    @contextmanager
    def call(self, transport: str, method: str, timed: bool = True) -> Iterator["Call"]:
        """Count and time one call; the caller sets its code.

        Args:
            transport: "grpc" or "rest".
            method: method of the contract.
            timed: False for streams, which last as long as the client wants.
        """
        call = Call()
        started = perf_counter()
        try:
            yield call
        finally:
            self.requests.labels(transport, method, call.code).inc()
            if call.key is not None:
                self.keys.count(call.key, call.code)
            if timed:
                exemplar = {"trace_id": call.trace_id} if call.trace_id else None
                self.request_duration.labels(transport, method).observe(perf_counter() - started, exemplar)

    def render(self) -> bytes:
        """Return the metrics in the Prometheus text format; this changes nothing."""
        return generate_latest(self.registry)

    def render_for(self, accept: str) -> tuple[bytes, str]:
        """Return the metrics with their media type: in OpenMetrics with exemplars, if that is accepted.

        Args:
            accept: the Accept header.
        """
        encode, media_type = choose_encoder(accept)
        return encode(self.registry), media_type


def _by_name(infos: list[ModelInfo], default: ModelInfo) -> dict[str, ModelInfo]:
    """Return the version of each name that a request without a version gets.

    It is the default model's, else the newest causal version, else the newest version.
    """
    causal_last = sorted(infos, key=lambda info: info.protocol is Protocol.CAUSAL)
    return {info.name: info for info in [*causal_last, default]}


class Call:
    """Result of a call."""

    def __init__(self) -> None:
        self.code = "CANCELLED"
        """Canonical status code; it stays CANCELLED if the client disconnects first."""
        self.trace_id = ""
        """Id of the trace, if it is sampled; else empty."""
        self.key: str | None = None
        """Name of the API key; None: there is none, or it was not accepted."""
