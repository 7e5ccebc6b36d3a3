"""What the track memory costs: ``python -m loadtest.tracking``.

Two servers, one that remembers by itself and one with a Redis of its own, are called with and without a
scene_id, in turns, so that what else the machine does meets both alike. Then other scenes are remembered,
more and more of them; and what they take is weighed.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import typer
from rich.console import Console
from rich.table import Table

from loadtest.crowd import MODEL, SECONDS, Crowd
from loadtest.servers import random_checkpoint
from loadtest.stores import Store, stores
from loadtest.turns import AGENTS, STATES, Times, Turn, Turns

_ADDED_MS = 1.5
_ROUND_TRIPS = 1
_RATES = (2.0, 10.0)
"""Hz, at which agents are weighed."""
_HISTORY = {"tracked": "request", "recalled": "memory"}


class Weight(NamedTuple):
    """What an agent takes in one store."""

    store: str
    rate: float
    """Hz, of its scene's calls."""
    redis: float
    """Bytes in Redis; 0 without it."""
    process: float
    """Bytes in the server."""


def weigh(store: Store, rate: float, agents: int) -> Weight:
    """What agents take that were called for longer than they are remembered.

    Args:
        store: whose.
        rate: Hz.
        agents: how many to weigh; the more, the better.
    """
    # The same calls without a scene first: what the process takes for them is not the memory's
    Crowd(store, "", tracked=False).grow(agents, rate)
    crowd = Crowd(store, f"weighed-at-{rate:g}-hz")
    before = store.resident()
    crowd.grow(agents, rate)
    process = store.resident() - before
    return Weight(store.name, rate, store.held(crowd.name) / agents, process / agents)


def latency(servers: list[Store], models: Sequence[str], rounds: int) -> Table:
    """What tracking adds to a call.

    Args:
        servers: to be compared.
        models: to be called.
        rounds: calls of each kind.
    """
    table = Table(
        title=f"calls of {AGENTS} vehicles with {STATES} states each, 2 Hz; target: "
        f"p50 + {_ADDED_MS} ms, {_ROUND_TRIPS} round trip"
    )
    for heading in ("model", "store", "history from"):
        table.add_column(heading)
    for heading in ("untracked p50", "p90, ms", "added p50, ms", "p90, ms", "round trips", "unanswered"):
        table.add_column(heading, justify="right")
    for model in models:
        _add_model(table, servers, model, rounds)
    return table


def _add_model(table: Table, servers: list[Store], model: str, rounds: int) -> None:
    turns = Turns(servers, ("untracked", "tracked", "recalled"), model)
    times, trips = turns.measure(rounds), turns.round_trips()
    turns.forget()
    for turn, own in times.items():
        if turn.way == "untracked":
            continue
        without = times[Turn(turn.store, "untracked")]
        table.add_row(
            model,
            turn.store,
            _HISTORY[turn.way],
            *(f"{without.quantile_ms(share):.2f}" for share in (0.5, 0.9)),
            *_added(own, without),
            f"{trips[turn]:g}",
            f"{own.unavailable} of {rounds}",
        )


def _added(times: Times, without: Times) -> list[str]:
    """To the median, with its 95 % interval, and to the 90th percentile."""
    added = times.added(without)
    return [
        f"{added.median:+.2f} ({added.low:.2f} … {added.high:.2f})",
        f"{times.quantile_ms(0.9) - without.quantile_ms(0.9):+.2f}",
    ]


def flatness(servers: list[Store], live: Sequence[int], rounds: int) -> Table:
    """What tracking adds to a call while agents of other scenes are remembered.

    Args:
        servers: to be compared.
        live: how many agents.
        rounds: calls of each kind, for each number of them.
    """
    table = Table(title=f"the same calls, {MODEL}, while other scenes are remembered")
    table.add_column("agents there", justify="right")
    for store in servers:
        for heading in (f"{store.name}, untracked p50", "added p50", "p90, ms", "unanswered"):
            table.add_column(heading, justify="right")
    crowds = [Crowd(store, "crowd") for store in servers]
    turns = Turns(servers, ("untracked", "tracked"), MODEL)
    for agents in sorted(live):
        for crowd in crowds:
            crowd.grow(agents, 2.0)
        times = turns.measure(rounds)
        cells = []
        for store in servers:
            own, without = times[Turn(store.name, "tracked")], times[Turn(store.name, "untracked")]
            cells += [
                f"{without.quantile_ms(0.5):.2f}",
                *_added(own, without),
                f"{own.unavailable} of {rounds}",
            ]
        table.add_row(str(agents), *cells)
    return table


def weights(servers: list[Store], agents: int) -> Table:
    """What an agent takes.

    Args:
        servers: to be compared.
        agents: how many to weigh.
    """
    table = Table(title=f"bytes of an agent after {SECONDS} s of calls")
    for heading in ("store", "calls, Hz", "in Redis", "in the server"):
        table.add_column(heading, justify="left" if heading == "store" else "right")
    for store in servers:
        for rate in _RATES:
            weight = weigh(store, rate, agents)
            held = f"{weight.redis:,.0f}" if store.redis is not None else ""
            table.add_row(store.name, f"{rate:g}", held, f"{weight.process:,.0f}")
    return table


def main(
    model: Annotated[list[str] | None, typer.Option(help="to call; default: kalman and a random CAB")] = None,
    rounds: Annotated[int, typer.Option(min=2, help="calls of each kind")] = 200,
    live: Annotated[
        list[int] | None, typer.Option(min=1, help="agents in other scenes; default: 10 … 10,000")
    ] = None,
    weighed: Annotated[int, typer.Option(min=1, help="agents to weigh")] = 400,
) -> None:
    """Prints three tables: time, time beside other scenes, and room."""
    console = Console()
    with tempfile.TemporaryDirectory() as models:
        random_checkpoint(Path(models))
        with stores(Path(models)) as servers:
            console.print(latency(servers, model or ("kalman", "cab"), rounds))
            console.print(flatness(servers, live or [10, 100, 1000, 10_000], rounds))
            console.print(weights(servers, weighed))


if __name__ == "__main__":
    typer.run(main)
