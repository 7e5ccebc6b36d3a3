"""Cost of the track memory in time and memory: ``python -m loadtest.tracking``.

Two servers, one with in-process track memory and one with a Redis of its own, are called with and without a
scene_id, in random order, so that other load on the machine affects both equally. The calls are repeated
while the track memory holds more and more other scenes. Finally the memory per agent is measured.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from rich.console import Console
from rich.table import Table

from loadtest.background_scenes import MODEL, SECONDS, BackgroundScenes
from loadtest.paired_latency import AGENTS, STATES, Latencies, PairedLatency, Variant
from loadtest.servers import random_checkpoint
from loadtest.stores import Store, stores

_TARGET_ADDED_MS = 1.5
_TARGET_ROUND_TRIPS = 1
_RATES = (2.0, 10.0)
"""Call rates at which the memory per agent is measured, Hz."""
_HISTORY = {"tracked": "request", "recalled": "memory"}


class AgentMemory(NamedTuple):
    """Memory per agent in one store."""

    store: str
    rate: float
    """Call rate of its scene, Hz."""
    redis: float
    """Bytes in Redis; 0 without Redis."""
    process: float
    """Bytes in the server."""


def memory_per_agent(store: Store, rate: float, agents: int) -> AgentMemory:
    """Return the memory per agent once the window of the track memory is full.

    Args:
        store: the server.
        rate: calls per scene, Hz.
        agents: number of agents; more give a better estimate.
    """
    # First the same calls without a scene_id: what the process allocates for them is not track memory
    BackgroundScenes(store, "", tracked=False).grow(agents, rate)
    scenes = BackgroundScenes(store, f"weighed-at-{rate:g}-hz")
    before = store.resident()
    scenes.grow(agents, rate)
    process = store.resident() - before
    return AgentMemory(store.name, rate, store.redis_bytes(scenes.name) / agents, process / agents)


def latency_table(servers: list[Store], models: Sequence[str], rounds: int) -> Table:
    """Return a table of the latency that tracking adds to a call.

    Args:
        servers: servers to compare.
        models: models to request.
        rounds: calls per variant.
    """
    table = Table(
        title=f"calls of {AGENTS} vehicles with {STATES} states each, 2 Hz; target: "
        f"p50 + {_TARGET_ADDED_MS} ms, {_TARGET_ROUND_TRIPS} round trip"
    )
    for heading in ("model", "store", "history from"):
        table.add_column(heading)
    for heading in ("untracked p50", "p90, ms", "added p50, ms", "p90, ms", "round trips", "unavailable"):
        table.add_column(heading, justify="right")
    for model in models:
        _add_model(table, servers, model, rounds)
    return table


def _add_model(table: Table, servers: list[Store], model: str, rounds: int) -> None:
    pairs = PairedLatency(servers, ("untracked", "tracked", "recalled"), model)
    latencies, trips = pairs.measure(rounds), pairs.round_trips()
    pairs.reset()
    for variant, own in latencies.items():
        if variant.mode == "untracked":
            continue
        baseline = latencies[Variant(variant.store, "untracked")]
        table.add_row(
            model,
            variant.store,
            _HISTORY[variant.mode],
            *(f"{baseline.quantile_ms(share):.2f}" for share in (0.5, 0.9)),
            *_added(own, baseline),
            f"{trips[variant]:g}",
            f"{own.unavailable} of {rounds}",
        )


def _added(latencies: Latencies, baseline: Latencies) -> list[str]:
    """Return the latency added to the median, with its 95 % interval, and to the 90th percentile."""
    added = latencies.added_to(baseline)
    return [
        f"{added.median:+.2f} ({added.low:.2f} … {added.high:.2f})",
        f"{latencies.quantile_ms(0.9) - baseline.quantile_ms(0.9):+.2f}",
    ]


def scaling_table(servers: list[Store], live: Sequence[int], rounds: int) -> Table:
    """Return a table of the latency that tracking adds while the track memory holds other scenes.

    Args:
        servers: servers to compare.
        live: numbers of agents in the other scenes.
        rounds: calls per variant and number of agents.
    """
    table = Table(title=f"the same calls, {MODEL}, with other scenes in the track memory")
    table.add_column("other agents", justify="right")
    for store in servers:
        for heading in (f"{store.name}, untracked p50", "added p50", "p90, ms", "unavailable"):
            table.add_column(heading, justify="right")
    background = [BackgroundScenes(store, "crowd") for store in servers]
    pairs = PairedLatency(servers, ("untracked", "tracked"), MODEL)
    for agents in sorted(live):
        for scenes in background:
            scenes.grow(agents, 2.0)
        latencies = pairs.measure(rounds)
        cells = []
        for store in servers:
            own = latencies[Variant(store.name, "tracked")]
            baseline = latencies[Variant(store.name, "untracked")]
            cells += [
                f"{baseline.quantile_ms(0.5):.2f}",
                *_added(own, baseline),
                f"{own.unavailable} of {rounds}",
            ]
        table.add_row(str(agents), *cells)
    return table


def memory_table(servers: list[Store], agents: int) -> Table:
    """Return a table of the memory per agent.

    Args:
        servers: servers to compare.
        agents: number of agents to measure.
    """
    table = Table(title=f"bytes per agent after {SECONDS} s of calls")
    for heading in ("store", "calls, Hz", "in Redis", "in the server"):
        table.add_column(heading, justify="left" if heading == "store" else "right")
    for store in servers:
        for rate in _RATES:
            memory = memory_per_agent(store, rate, agents)
            in_redis = f"{memory.redis:,.0f}" if store.redis is not None else ""
            table.add_row(store.name, f"{rate:g}", in_redis, f"{memory.process:,.0f}")
    return table


def main(
    model: Annotated[
        list[str] | None, typer.Option(help="models to request; default: kalman and a random CAB")
    ] = None,
    rounds: Annotated[int, typer.Option(min=2, help="calls per variant")] = 200,
    live: Annotated[
        list[int] | None, typer.Option(min=1, help="agents in other scenes; default: 10 … 10,000")
    ] = None,
    weighed: Annotated[int, typer.Option(min=1, help="agents for the memory per agent")] = 400,
) -> None:
    """Print three tables: added latency, added latency by other scenes, and memory per agent."""
    console = Console()
    with tempfile.TemporaryDirectory() as models:
        random_checkpoint(Path(models))
        with stores(Path(models)) as servers:
            console.print(latency_table(servers, model or ("kalman", "cab"), rounds))
            console.print(scaling_table(servers, live or [10, 100, 1000, 10_000], rounds))
            console.print(memory_table(servers, weighed))


if __name__ == "__main__":
    typer.run(main)
