"""Tables of text, and how figures are written in them."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

NOTHING = "-"
"""For what is not known."""


@dataclass(frozen=True)
class Table:
    """Columns of text; the first is the model."""

    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def metrics_table(
    title: str,
    note: str,
    columns: Mapping[str, str],
    rows: Iterable[tuple[str, Mapping[str, float]]],
    digits: int = 2,
) -> Table:
    """A column a metric.

    Args:
        title: of the table.
        note: what its figures are of.
        columns: by heading, the metric's name.
        rows: each a model and its metrics.
        digits: after the point.
    """
    cells = tuple(
        (model, *(number(metrics.get(name, math.nan), digits) for name in columns.values()))
        for model, metrics in rows
    )
    return Table(title, note, ("model", *columns), cells)


def number(value: float, digits: int = 2) -> str:
    """A figure; counts as they are."""
    if isinstance(value, int):
        return str(value)
    return NOTHING if math.isnan(value) else f"{value:.{digits}f}"


def signed(value: float, digits: int = 2) -> str:
    """A difference, with its sign."""
    return NOTHING if math.isnan(value) else f"{value:+.{digits}f}"


def document(title: str, tables: Iterable[Table], lines: Sequence[str] = ()) -> str:
    """Markdown of tables, each with what it is of.

    Args:
        title: of the whole.
        tables: in order.
        lines: what is to be known before them, as a list.
    """
    parts = [f"# {title}"]
    if lines:
        parts.append("\n".join(f"- {line}" for line in lines))
    for table in tables:
        parts.append(f"## {table.title}\n\n{table.note}")
        rows = [table.columns, ("---", *("--:" for _ in table.columns[1:])), *table.rows]
        parts.append("\n".join(_line(row) for row in rows))
    return "\n\n".join(parts) + "\n"


def _line(cells: Sequence[str]) -> str:
    escaped = (cell.replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"
