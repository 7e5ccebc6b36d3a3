"""Results of comparisons with peers: figures, tables, and the file that keeps them."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import median

from pydantic import BaseModel


class Measured(BaseModel):
    """A server in one measurement."""

    calls_per_second: float
    p50_ms: float
    p99_ms: float
    client_cpu: float
    """Share of one core that the clients used."""
    answers_checked: int
    request_bytes: int
    """Size of the first request."""


class Measurement(BaseModel):
    """A peer and our server, measured in turns with as many agents and clients."""

    agents: int
    clients: int
    peer: Measured
    ours: Measured


class Take(BaseModel):
    """Measurements of one peer beside our server."""

    name: str
    title: str
    input: str
    """Kind of its requests."""
    batches: str
    """Explanation of how it joins calls."""
    date: str
    conditions: str
    load_before: float
    """Number of threads that wanted to run on the machine in the minute before, on average."""
    raw_agents_per_second: float
    """The raw forward's best batch rate in the process of the clients, in the same run; 0: not measured."""
    measurements: list[Measurement]


class Comparisons(BaseModel):
    """Takes of several peers, the newest of each."""

    takes: list[Take] = []

    @classmethod
    def read(cls, file: Path) -> "Comparisons":
        """Return what a file holds; nothing if there is none."""
        return cls.model_validate_json(file.read_bytes()) if file.is_file() else cls()

    def add(self, take: Take) -> None:
        """Add a take, which replaces an earlier one of the same peer."""
        self.takes = [*(one for one in self.takes if one.name != take.name), take]

    def write(self, folder: Path) -> None:
        """Write ``peers.json`` and ``peers.md``."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "peers.json").write_text(self.model_dump_json(indent=1) + "\n", encoding="utf-8")
        (folder / "peers.md").write_text(self.markdown() + "\n", encoding="utf-8")

    def markdown(self) -> str:
        """Return a table for each number of agents, and how they were measured."""
        if not self.takes:
            return "Nothing has been measured yet."
        sizes = sorted({one.agents for take in self.takes for one in take.measurements})
        notes = "\n".join(f"- {line}" for line in self._notes())
        return "\n\n".join([*(self._table(agents) for agents in sizes), notes])

    def _notes(self) -> Iterable[str]:
        yield from sorted({f"{take.conditions}." for take in self.takes})
        days = sorted(take.date[:10] for take in self.takes)
        raw = [take.raw_agents_per_second for take in self.takes]
        yield (
            f"Measured on {' to '.join(dict.fromkeys((days[0], days[-1])))}. The raw forward's best batch "
            f"rate in the same runs: {_range(raw)} agents/s."
        )
        load = _range([take.load_before for take in self.takes])
        yield (
            f"Load average of the machine before the runs: {load}. Above 1, other work took part of the "
            "machine, and only the ratios hold."
        )
        sides = [side for take in self.takes for one in take.measurements for side in (one.peer, one.ours)]
        yield (
            f"{sum(side.answers_checked for side in sides)} answers were compared with the eager forward; "
            "none differs by more than 1 mm."
        )
        joins = {f"{take.title} joins {take.batches}" for take in self.takes if take.batches != "no"}
        yield f"{'; '.join(sorted(joins))}." if joins else "No peer joins calls."

    def _table(self, agents: int) -> str:
        """Return the table of one number of agents a call: a row for each server, ours first."""
        takes = [(take, [one for one in take.measurements if one.agents == agents]) for take in self.takes]
        clients = sorted({one.clients for _, own in takes for one in own})
        head = [f"{agents} agent{'s' if agents > 1 else ''} a call", "request, kB"]
        for count in clients:
            name = "1 client" if count == 1 else f"{count} clients"
            head += [f"{name}: calls/s", "p50, ms", "p99, ms"]
        counts = " / ".join(map(str, clients))
        head += [f"ours ÷ peer, calls/s ({counts})", f"clients' CPU, cores ({counts})"]
        rows = [head, ["---", *["---:"] * (len(head) - 1)]]
        every = [one for _, own in takes for one in own]
        rows.append(["**ours**", *_figures(every, clients, lambda one: one.ours)])
        for take, own in takes:
            rows.append([take.title, *_figures(own, clients, lambda one: one.peer)])
        return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _range(values: Sequence[float]) -> str:
    return " to ".join(dict.fromkeys(f"{value:.0f}" for value in (min(values), max(values))))


def _figures(
    measurements: Sequence[Measurement], clients: Sequence[int], side: Callable[[Measurement], Measured]
) -> list[str]:
    """Return the cells of one server, the medians of its measurements."""
    by_count = [[one for one in measurements if one.clients == count] for count in clients]

    def middle(own: Sequence[Measurement], figure: Callable[[Measurement], float]) -> float:
        return median(figure(one) for one in own)

    cells = [f"{side(measurements[0]).request_bytes / 1000:.0f}"]
    for own in by_count:
        cells.append(f"{middle(own, lambda one: side(one).calls_per_second):.0f}")
        cells.append(f"{middle(own, lambda one: side(one).p50_ms):.1f}")
        cells.append(f"{middle(own, lambda one: side(one).p99_ms):.1f}")
    ratios = [
        middle(own, lambda one: one.ours.calls_per_second / side(one).calls_per_second) for own in by_count
    ]
    cpu = [middle(own, lambda one: side(one).client_cpu) for own in by_count]
    cells.append(" / ".join(f"{ratio:.2f}" for ratio in ratios))
    cells.append(" / ".join(f"{share:.2f}" for share in cpu))
    return cells
