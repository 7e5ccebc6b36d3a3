"""Forecasts and tracking while Redis fails and recovers: ``python -m loadtest.redis_faults``.

A server with a Redis of its own is called at a steady rate while that Redis is killed, filled, slowed down
and paused. No forecast may fail, and tracking must recover by itself.
"""

import asyncio
import subprocess
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, NamedTuple

import httpx
import numpy as np
import psutil
import redis
import typer
from prometheus_client.parser import text_string_to_metric_families
from rich.console import Console
from rich.table import Table

from cab_forecast import AsyncClient, Tracking
from loadtest.load import Call, SteadyLoad
from loadtest.redis_servers import FaultProxy, Process, until
from loadtest.servers import Server, serving
from loadtest.stores import redis_server

MODEL = "kalman"
DELAY = 0.05
"""Delay of the slow network in each direction, s; a call waits 20 ms for both."""
_ERRORS = "forecast_track_store_errors_total"
_RECOVERY_TIMEOUT = 10.0
"""Seconds that the recovery may take beyond its phase."""
_WARM_UP = 1.0
"""Seconds of calls before the first phase."""
_POLL_INTERVAL = 0.05
"""Seconds between checks for the recovery."""
_HEADROOM = 8 * 2**20
"""Bytes of Redis memory that ``fill`` leaves free before it writes the ballast."""
_BALLAST_SIZES = tuple(4**power for power in range(9, 1, -1))
"""Sizes of the ballast values, descending, so that the last bytes are filled too."""


class FaultyRedis:
    """Redis server behind a proxy, with faults that are injected on demand. Its methods block.

    Args:
        server: the server.
        proxy: the proxy in front of it.
        log: log file of a restarted server.
    """

    def __init__(self, server: Process, proxy: FaultProxy, log: Path) -> None:
        self._server = server
        self._proxy = proxy
        self._log = log
        self._ballast: list[str] = []

    @property
    def url(self) -> str:
        """URL of the server through the proxy."""
        return self._proxy.url

    def connections(self) -> int:
        """Return the number of connections of the forecast server."""
        return self._server.text("CLIENT LIST").count("name=cab-forecast ")

    def used_memory(self) -> int:
        """Return the memory that Redis uses, bytes."""
        info = self._server.text("INFO memory")
        return int(next(line for line in info.splitlines() if line.startswith("used_memory:")).split(":")[1])

    def do_nothing(self) -> None:
        """Inject no fault."""

    def kill(self) -> None:
        """Kill the server; its data is lost."""
        self._server.kill()

    def start_empty(self) -> None:
        """Start an empty server in its place."""
        with self._log.open("ab") as log:
            self._server.process = subprocess.Popen(  # noqa: S603
                self._server.process.args, stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        until(lambda: self._server.command("PING") == b"PONG")

    def fill(self) -> None:
        """Fill the memory completely, without eviction."""
        self._server.command("CONFIG", "SET", "maxmemory-policy", "noeviction")
        self._server.command("CONFIG", "SET", "maxmemory", self.used_memory() + _HEADROOM)
        for size in _BALLAST_SIZES:
            try:
                while True:
                    self._server.command("SET", f"ballast:{len(self._ballast)}", "x" * size)
                    self._ballast.append(f"ballast:{len(self._ballast)}")
            except redis.OutOfMemoryError:
                pass

    def free(self) -> None:
        """Delete the ballast; the memory limit stays."""
        self._server.command("DEL", *self._ballast)
        self._ballast.clear()

    def slow_down(self) -> None:
        """Delay the traffic."""
        self._proxy.set("slow", DELAY)

    def speed_up(self) -> None:
        """Stop delaying the traffic."""
        self._proxy.set("pass")

    def pause(self) -> None:
        """Pause the server: connections stay open, and nothing is answered."""
        self._server.pause()

    def resume(self) -> None:
        """Continue after ``pause``."""
        self._server.resume()


@contextmanager
def faulty_redis() -> Iterator[FaultyRedis]:
    """Run a Redis behind a proxy on free ports.

    Raises:
        typer.Exit: Redis is not installed.
    """
    with redis_server() as server, FaultProxy(server.port) as proxy:
        yield FaultyRedis(server, proxy, server.folder / "log")


class Phase(NamedTuple):
    """Fault or repair, and its duration."""

    name: str
    begin: Callable[[FaultyRedis], None]
    share: float
    """Share of the duration of the whole run."""
    healthy: bool
    """True if tracking must recover in this phase."""


PHASES = (
    Phase("healthy", FaultyRedis.do_nothing, 0.16, healthy=True),
    Phase("killed", FaultyRedis.kill, 0.1, healthy=False),
    Phase("started empty", FaultyRedis.start_empty, 0.11, healthy=True),
    Phase("full", FaultyRedis.fill, 0.1, healthy=False),
    Phase("freed", FaultyRedis.free, 0.11, healthy=True),
    Phase("slow", FaultyRedis.slow_down, 0.1, healthy=False),
    Phase("quick again", FaultyRedis.speed_up, 0.11, healthy=True),
    Phase("hanging", FaultyRedis.pause, 0.1, healthy=False),
    Phase("awake again", FaultyRedis.resume, 0.11, healthy=True),
)


class Resources(NamedTuple):
    """System resources that the server holds."""

    connections: int
    """Connections to Redis."""
    files: int
    """Open files and connections, without those to Redis."""
    threads: int
    resident: int
    """Bytes."""


@dataclass(frozen=True)
class PhaseResult:
    """Result of one phase."""

    name: str
    healthy: bool
    """True if tracking had to recover in this phase."""
    calls: Sequence[Call]
    """Calls sent in this phase."""
    errors: "Counter[str]"
    """Errors of the track memory by reason."""
    recovered: float | None
    """Seconds from the start of the phase until every scene was tracked again; None: one never was."""

    @property
    def failures(self) -> list[str]:
        """Failures of forecasts."""
        return [call.failure for call in self.calls if call.failure]

    @property
    def statuses(self) -> "Counter[str]":
        """Tracking statuses of the calls that did not fail."""
        return Counter(call.tracking.value for call in self.calls if not call.failure)

    def quantile_ms(self, share: float) -> float:
        """Return a quantile of the calls' latency."""
        return 1e3 * float(np.quantile([call.seconds for call in self.calls], share))


@dataclass(frozen=True)
class Report:
    """Result of a run."""

    phases: Sequence[PhaseResult]
    """The first phase is healthy."""
    before: Resources
    after: Resources
    logged: Sequence[str]
    """Events that the server logged as errors."""

    def problems(self) -> list[str]:
        """Return what must not happen but did."""
        problems = []
        for phase in self.phases:
            if phase.failures:
                problems.append(f"{phase.name}: {len(phase.failures)} forecasts failed: {phase.failures[0]}")
            if phase.healthy and phase.recovered is None:
                problems.append(f"{phase.name}: tracking did not recover")
        return problems


def show(report: Report) -> None:
    """Print a row per phase, and the resources of the server before and after."""
    console = Console()
    table = Table(title="forecasts while the track memory fails")
    table.add_column("redis")
    for heading in ("calls", "failed", "p50, ms", "p99, ms", "added p50 / p99, ms"):
        table.add_column(heading, justify="right")
    for heading in ("tracking", "errors of the memory", "OK again after, s"):
        table.add_column(heading)
    healthy = report.phases[0]
    for phase in report.phases:
        added = [phase.quantile_ms(share) - healthy.quantile_ms(share) for share in (0.5, 0.99)]
        recovered = "never" if phase.recovered is None else f"{phase.recovered:.2f}"
        table.add_row(
            phase.name,
            str(len(phase.calls)),
            str(len(phase.failures)),
            f"{phase.quantile_ms(0.5):.1f}",
            f"{phase.quantile_ms(0.99):.1f}",
            f"{added[0]:+.1f} / {added[1]:+.1f}",
            _counts(phase.statuses),
            _counts(phase.errors),
            recovered if phase.healthy and phase is not healthy else "",
        )
    console.print(table)
    before, after = report.before, report.after
    console.print(
        f"before → after: {before.connections} → {after.connections} connections to Redis, "
        f"{before.files} → {after.files} other open files, {before.threads} → {after.threads} threads, "
        f"{before.resident / 2**20:.0f} → {after.resident / 2**20:.0f} MiB resident; "
        f"{len(report.logged)} errors logged"
    )


async def run_phases(
    server: Server, faulty: FaultyRedis, seconds: float, rate: float, scenes: int, agents: int
) -> Report:
    """Run all phases.

    Args:
        server: forecast server with the Redis as its track memory.
        faulty: the Redis.
        seconds: duration of all phases together; the run is longer where tracking recovers slowly.
        rate: calls/s.
        scenes: number of scenes.
        agents: agents per scene.
    """
    begins: list[float] = []
    recovered: list[float | None] = []
    async with (
        AsyncClient(f"grpc://{server.grpc}", retries=0) as client,
        httpx.AsyncClient(base_url=f"http://{server.http}") as http,
        asyncio.TaskGroup() as group,
    ):
        load, stop = SteadyLoad(client, MODEL, rate, scenes, agents), asyncio.Event()
        group.create_task(load.run(stop))
        try:
            await asyncio.sleep(_WARM_UP)
            errors = [await _errors(http)]
            before = await asyncio.to_thread(_resources, server, faulty)
            for phase in PHASES:
                # Until the fault or repair is in effect, calls belong to the previous phase
                await asyncio.to_thread(phase.begin, faulty)
                begins.append(time.perf_counter())
                await asyncio.sleep(phase.share * seconds)
                timeout = _RECOVERY_TIMEOUT if phase.healthy else 0.0
                recovered.append(await _recovery(load, begins[-1], timeout))
                errors.append(await _errors(http))
            after = await asyncio.to_thread(_resources, server, faulty)
        finally:
            stop.set()
    calls = _by_phase(load.calls, begins)
    counts = [new - old for old, new in pairwise(errors)]
    phases = [
        PhaseResult(phase.name, phase.healthy, *rest)
        for phase, rest in zip(PHASES, zip(calls, counts, recovered, strict=True), strict=True)
    ]
    return Report(phases, before, after, server.errors())


def run(seconds: float, rate: float, scenes: int, agents: int) -> Report:
    """Start Redis and a server, and run all phases; arguments as in ``run_phases``."""
    with (
        tempfile.TemporaryDirectory() as no_models,
        faulty_redis() as faulty,
        serving(Path(no_models), store=faulty.url) as server,
    ):
        return asyncio.run(run_phases(server, faulty, seconds, rate, scenes, agents))


def _by_phase(calls: list[Call], begins: list[float]) -> list[list[Call]]:
    """Return the calls of each phase, without those before the first phase."""
    bounds = pairwise([*begins, float("inf")])
    return [[call for call in calls if begin <= call.sent < end] for begin, end in bounds]


async def _recovery(load: SteadyLoad, since: float, timeout_s: float) -> float | None:
    """Return the seconds until every scene was tracked again; None: one was not before the timeout."""
    for _ in range(round(timeout_s / _POLL_INTERVAL) + 1):
        first: dict[int, float] = {}
        for call in load.calls:
            if call.sent >= since and call.tracking is Tracking.OK:
                first.setdefault(call.scene, call.sent + call.seconds - since)
        if len(first) == load.scenes:
            return max(first.values())
        await asyncio.sleep(_POLL_INTERVAL)
    return None


async def _errors(http: httpx.AsyncClient) -> "Counter[str]":
    """Return the number of track memory errors so far, by reason."""
    text = (await http.get("/metrics")).raise_for_status().text
    counts: Counter[str] = Counter()
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            if sample.name == _ERRORS:
                counts[sample.labels["reason"]] += round(sample.value)
    return counts


def _resources(server: Server, faulty: FaultyRedis) -> Resources:
    process = psutil.Process(server.process.pid)
    connections = faulty.connections()
    return Resources(
        connections,
        process.num_fds() - connections,
        process.num_threads(),
        process.memory_info().rss,
    )


def _counts(counts: "Counter[str]") -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.most_common() if count)


def main(
    seconds: Annotated[float, typer.Option(min=1, help="duration of all phases together")] = 60.0,
    rate: Annotated[float, typer.Option(min=1, help="calls/s")] = 40.0,
    scenes: Annotated[int, typer.Option(min=1)] = 4,
    agents: Annotated[int, typer.Option(min=1, help="agents per scene")] = 8,
) -> None:
    """Print a row per phase; fail if a forecast failed or tracking did not recover."""
    report = run(seconds, rate, scenes, agents)
    show(report)
    problems = report.problems()
    for problem in problems:
        typer.echo(problem, err=True)
    if problems:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
