"""Faults of a server's surroundings, one by one: ``python -m loadtest.faults``.

They are rows of the fault matrix in docs/operations.md; ``loadtest.redis_faults`` has those of Redis. In each
row a server of its own is called over a connection that stays open and, over both transports, by callers who
open a new one each time. The table tells what either see during the fault, and how soon all is well after it.
"""

import asyncio
import resource
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

import grpc
import typer
from rich.console import Console
from rich.table import Table

from cab.forecast.v1.prediction_service_pb2_grpc import PredictionServiceStub
from cab_forecast import AsyncClient, Client, ForecastError, predict_request
from loadtest.load import SteadyLoad
from loadtest.servers import Server, serving
from loadtest.traffic import START, Traffic

MODEL = "kalman"
TIMEOUT = 1.5
"""Seconds that callers wait for a response, unless said otherwise."""
_RECOVERY_SECONDS = 10.0
_RATE = 10.0
_SCENES, _AGENTS, _STATES = 2, 4, 5
_FILE_BYTES = 2**16
"""Size beyond which files cannot grow on the full disk."""


@dataclass
class Victim:
    """The server that the faults befall."""

    server: Server
    models: Path
    record: Path
    timeout: float
    """Seconds that its callers wait for a response."""
    limits: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Former limits of the process, by resource."""

    @property
    def grpc(self) -> str:
        """Endpoint of gRPC."""
        return f"grpc://{self.server.grpc}"

    def limit(self, kind: int, value: int) -> None:
        """Lower a limit of the process."""
        self.limits[kind] = resource.prlimit(self.server.process.pid, kind)
        resource.prlimit(self.server.process.pid, kind, (value, self.limits[kind][1]))

    def unlimit(self, kind: int) -> None:
        """Set a limit back."""
        resource.prlimit(self.server.process.pid, kind, self.limits.pop(kind))

    def do_nothing(self) -> None:
        """Leave all as it is."""

    def take_descriptors(self) -> None:
        """Let the process open no more files or connections than it has: none below the limit is free."""
        held = {int(file.name) for file in Path(f"/proc/{self.server.process.pid}/fd").iterdir()}
        self.limit(resource.RLIMIT_NOFILE, min(set(range(len(held) + 1)) - held))

    def give_descriptors(self) -> None:
        """Let it open more again."""
        self.unlimit(resource.RLIMIT_NOFILE)

    def fill_disk(self) -> None:
        """Let files of the process grow no more, as on a full disk."""
        self.limit(resource.RLIMIT_FSIZE, _FILE_BYTES)

    def free_disk(self) -> None:
        """Let them grow again."""
        self.unlimit(resource.RLIMIT_FSIZE)

    def damage_checkpoint(self) -> None:
        """Put a checkpoint among the models that cannot be read, and have the server read them again.

        Raises:
            RuntimeError: the server did not refuse it.
        """
        (self.models / "damaged").mkdir()
        (self.models / "damaged/config.json").write_text("{", encoding="ascii")
        with Client(self.grpc) as client:
            if len(client.reload_models(timeout=20).refused) != 1:
                raise RuntimeError("the server did not refuse a damaged checkpoint")

    def remove_checkpoint(self) -> None:
        """Remove the damaged checkpoint."""
        (self.models / "damaged/config.json").unlink()
        (self.models / "damaged").rmdir()

    def stop(self) -> None:
        """Stop the process, as a machine that swaps or a debugger does."""
        self.server.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Let the process go on."""
        self.server.process.send_signal(signal.SIGCONT)


class Fault(NamedTuple):
    """A row: a fault, its repair, and what callers may see of it."""

    name: str
    begin: Callable[[Victim], None]
    end: Callable[[Victim], None]
    seen: frozenset[str] = frozenset()
    """Codes that callers with a new connection may get."""
    seen_by_all: bool = False
    """True if callers with an open connection may get them, too."""


_UNREACHABLE = frozenset(("UNAVAILABLE", "DEADLINE_EXCEEDED"))
FAULTS = (
    Fault("none", Victim.do_nothing, Victim.do_nothing),
    Fault("out of descriptors", Victim.take_descriptors, Victim.give_descriptors, _UNREACHABLE),
    Fault("corrupt checkpoint", Victim.damage_checkpoint, Victim.remove_checkpoint),
    Fault("disk of the recording full", Victim.fill_disk, Victim.free_disk),
    Fault("process stopped", Victim.stop, Victim.resume, _UNREACHABLE, seen_by_all=True),
)


@dataclass(frozen=True)
class Row:
    """What callers saw of a fault."""

    fault: Fault
    kept: "Counter[str]"
    """Calls over the connection that stayed open, by code."""
    new: "Counter[str]"
    """Calls over new connections, by code."""
    recovered: float | None
    """Seconds from the repair until new callers of both transports were answered; None: they never were."""

    def problems(self) -> list[str]:
        """Return what must not happen but did."""
        name, allowed = self.fault.name, {"OK", *self.fault.seen}
        found = [f"{name}: a new caller got {code}" for code in self.new if code not in allowed]
        allowed = allowed if self.fault.seen_by_all else {"OK"}
        found += [f"{name}: an open connection got {code}" for code in self.kept if code not in allowed]
        if self.fault.seen and not self.fault.seen & self.new.keys():
            found.append(f"{name}: nobody noticed, so the fault was none")
        if self.recovered is None:
            found.append(f"{name}: the server did not recover")
        return found


@contextmanager
def victim(timeout: float = TIMEOUT) -> Iterator[Victim]:
    """Run a server with a folder of models and one for recordings."""
    with tempfile.TemporaryDirectory() as folder:
        models, record = Path(folder) / "models", Path(folder) / "record"
        models.mkdir()
        with serving(models, record=record, default_model=MODEL) as server:
            yield Victim(server, models, record, timeout)


async def call_anew(of: Victim) -> list[str]:
    """Return the codes of a call over REST and one over gRPC, each over a new connection."""
    request = predict_request(START, Traffic(_AGENTS).agents(START, _STATES), model=MODEL, merge=False)

    async def rest() -> str:
        try:
            async with AsyncClient(f"http://{of.server.http}", timeout=of.timeout, retries=0) as client:
                await client.predict(request)
        except ForecastError as error:
            return error.code
        return "OK"

    async def grpc_call() -> str:
        # Channels share their connections unless they are told not to
        options = [("grpc.use_local_subchannel_pool", 1)]
        async with grpc.aio.insecure_channel(of.server.grpc, options) as channel:
            try:
                await PredictionServiceStub(channel).Predict(request, timeout=of.timeout)
            except grpc.aio.AioRpcError as error:
                return error.code().name
        return "OK"

    return list(await asyncio.gather(rest(), grpc_call()))


async def run_row(fault: Fault, of: Victim, seconds: float) -> Row:
    """Let a fault befall a server that is called.

    Args:
        fault: the fault.
        of: the server.
        seconds: time for which the fault lasts.
    """
    stop, new = asyncio.Event(), Counter[str]()
    async with AsyncClient(of.grpc, timeout=of.timeout, retries=0) as client, asyncio.TaskGroup() as group:
        await client.list_models()  # the connection is open before the fault
        load = SteadyLoad(client, MODEL, _RATE, _SCENES, _AGENTS)
        await asyncio.to_thread(fault.begin, of)
        group.create_task(load.run(stop))
        try:
            end = time.perf_counter() + seconds
            while time.perf_counter() < end:
                new.update(await call_anew(of))
                await asyncio.sleep(0.1)
        finally:
            await asyncio.to_thread(fault.end, of)
            repaired = time.perf_counter()
        recovered = await _recovery(of, repaired)
        stop.set()
    kept = Counter(call.failure.partition(":")[0] or "OK" for call in load.calls)
    return Row(fault, kept, new, recovered)


async def _recovery(of: Victim, since: float) -> float | None:
    while time.perf_counter() < since + _RECOVERY_SECONDS:
        if set(await call_anew(of)) == {"OK"}:
            return time.perf_counter() - since
    return None


def run(seconds: float, faults: Sequence[Fault] = FAULTS, timeout: float = TIMEOUT) -> list[Row]:
    """Start a server, and let faults befall it one after the other.

    Args:
        seconds: time for which each fault lasts.
        faults: the faults.
        timeout: seconds that callers wait for a response.
    """
    with victim(timeout) as of:
        return [asyncio.run(run_row(fault, of, seconds)) for fault in faults]


def show(rows: Sequence[Row]) -> None:
    """Print what callers saw."""
    table = Table(title="forecasts while the server's surroundings fail")
    for heading in ("fault", "open connection", "new connections", "all well after, s"):
        table.add_column(heading)
    for row in rows:
        recovered = "never" if row.recovered is None else f"{row.recovered:.2f}"
        table.add_row(row.fault.name, _codes(row.kept), _codes(row.new), recovered)
    Console(width=120).print(table)


def _codes(counts: "Counter[str]") -> str:
    return ", ".join(f"{count} {code}" for code, count in sorted(counts.items()))


def main(
    seconds: Annotated[float, typer.Option(min=0.5, help="time for which each fault lasts")] = 5.0,
) -> None:
    """Print a row for each fault; fail if callers saw what they must not see, or a server did not recover."""
    rows = run(seconds)
    show(rows)
    problems = [problem for row in rows for problem in row.problems()]
    for problem in problems:
        typer.echo(problem, err=True)
    if problems:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
