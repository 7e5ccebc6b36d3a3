"""What became of forecasts and tracking while Redis was broken, and how it is shown."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from loadtest.load import Call


class Held(NamedTuple):
    """What the server holds of the system."""

    connections: int
    """To Redis."""
    files: int
    """Open files and connections, but for those to Redis."""
    threads: int
    resident: int
    """Bytes."""


@dataclass(frozen=True)
class Outcome:
    """What became of one phase."""

    name: str
    well: bool
    """Whether tracking must have come back in it."""
    calls: Sequence[Call]
    """Those that were sent in it."""
    errors: "Counter[str]"
    """Of the track memory, by reason."""
    recovered: float | None
    """s from its beginning until each scene was tracked as usual; None: some never was."""

    @property
    def failures(self) -> list[str]:
        """What became of forecasts that are not there."""
        return [call.failure for call in self.calls if call.failure]

    @property
    def statuses(self) -> "Counter[str]":
        """Of the calls' scenes."""
        return Counter(call.tracking.value for call in self.calls if not call.failure)

    def quantile_ms(self, share: float) -> float:
        """Of the calls' time."""
        return 1e3 * float(np.quantile([call.seconds for call in self.calls], share))


@dataclass(frozen=True)
class Report:
    """A whole run."""

    outcomes: Sequence[Outcome]
    """The first one is of a Redis that is well."""
    before: Held
    after: Held
    logged: Sequence[str]
    """What the server logged as errors."""

    def problems(self) -> list[str]:
        """What must not be."""
        found = []
        for outcome in self.outcomes:
            if outcome.failures:
                found.append(
                    f"{outcome.name}: {len(outcome.failures)} forecasts failed: {outcome.failures[0]}"
                )
            if outcome.well and outcome.recovered is None:
                found.append(f"{outcome.name}: tracking did not come back")
        return found


def show(report: Report) -> None:
    """Prints a row a phase, and what the server held before and after."""
    console = Console()
    table = Table(title="forecasts while the track memory is broken")
    table.add_column("redis")
    for heading in ("calls", "failed", "p50, ms", "p99, ms", "added p50 / p99, ms"):
        table.add_column(heading, justify="right")
    for heading in ("tracking", "errors of the memory", "OK again after, s"):
        table.add_column(heading)
    healthy = report.outcomes[0]
    for outcome in report.outcomes:
        added = [outcome.quantile_ms(share) - healthy.quantile_ms(share) for share in (0.5, 0.99)]
        again = "never" if outcome.recovered is None else f"{outcome.recovered:.2f}"
        table.add_row(
            outcome.name,
            str(len(outcome.calls)),
            str(len(outcome.failures)),
            f"{outcome.quantile_ms(0.5):.1f}",
            f"{outcome.quantile_ms(0.99):.1f}",
            f"{added[0]:+.1f} / {added[1]:+.1f}",
            _listed(outcome.statuses),
            _listed(outcome.errors),
            again if outcome.well and outcome is not healthy else "",
        )
    console.print(table)
    before, after = report.before, report.after
    console.print(
        f"before → after: {before.connections} → {after.connections} connections to Redis, "
        f"{before.files} → {after.files} other open files, {before.threads} → {after.threads} threads, "
        f"{before.resident / 2**20:.0f} → {after.resident / 2**20:.0f} MiB resident; "
        f"{len(report.logged)} errors logged"
    )


def _listed(counts: "Counter[str]") -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.most_common() if count)
