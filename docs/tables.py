"""Markdown tables of generated pages."""

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table without a line end after the last row."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(("|" + "|".join(line) + "|") if line[0] == "---" else _line(line) for line in lines)


def _line(cells: Sequence[str]) -> str:
    return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"
