"""Report of a load test: tables in Markdown and HTML, with a plot of latency against rate."""

import html
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from loadtest.results import Result

_MEBIBYTE = 2**20
_STYLE = """body { font: 15px/1.4 sans-serif; margin: 2em; }
table { border-collapse: collapse; }
th, td { border: 1px solid #ccc; padding: 0.2em 0.6em; text-align: right; }
th:first-child, td:first-child { text-align: left; }
.failed { color: #b00; }"""


@dataclass(frozen=True)
class Report:
    """Report of a load test."""

    title: str
    setup: Sequence[str]
    """Facts about the test, a line each."""
    results: Sequence[Result]
    notes: Sequence[str]

    @property
    def failures(self) -> list[str]:
        """Events that must not happen but did."""
        return [failure for result in self.results for failure in result.failures]

    @property
    def _all_notes(self) -> list[str]:
        return [*self.notes, *(f"{result.name}: {note}" for result in self.results for note in result.notes)]

    def markdown(self) -> str:
        """Return the report in Markdown."""
        parts = [f"# {self.title}", _list(self.setup)]
        parts += [_table(rows) for rows in (_calls(self.results), _server(self.results))]
        if self._all_notes:
            parts.append(_list(self._all_notes))
        if self.failures:
            parts += ["**Failed:**", _list(self.failures)]
        return "\n\n".join(parts) + "\n"

    def html(self) -> str:
        """Return the report as a page, with the plot if matplotlib is installed."""
        title = html.escape(self.title)
        return "\n".join(
            [
                f'<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>{title}</title>',
                f"<style>{_STYLE}</style><h1>{title}</h1>",
                _html_list(self.setup),
                _html_table(_calls(self.results)),
                _plot(self.results),
                _html_table(_server(self.results)),
                _html_list(self._all_notes),
                '<div class="failed">' + _html_list(self.failures) + "</div></html>",
            ]
        )

    def write(self, folder: Path) -> None:
        """Write ``report.md`` and ``report.html``."""
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "report.md").write_text(self.markdown(), encoding="utf-8")
        (folder / "report.html").write_text(self.html(), encoding="utf-8")


def _calls(results: Sequence[Result]) -> list[list[str]]:
    """Return the rows of the table of calls, the first with the headings."""
    rows = [
        [
            "run",
            "deadline",
            "offered/s",
            "offered",
            "accepted",
            "in time",
            "refused",
            "late",
            "cancelled",
            "lost",
            "wrong (checked)",
            "goodput/s",
            "ratio to peak",
            "p50, ms",
            "p99, ms",
            "longest refusal, ms",
            "normal after, s",
        ]
    ]
    for one in results:
        reasons = ", ".join(f"{reason} {count}" for reason, count in one.refused_by_reason.items() if count)
        refused = str(one.counts["refused"]) + (f" ({reasons})" if reasons else "")
        rows.append(
            [
                one.name,
                "none" if one.deadline is None else f"{1e3 * one.deadline:g} ms",
                f"{one.rate:.1f}",
                str(one.offered),
                str(one.accepted),
                str(one.counts["in time"]),
                refused,
                str(one.counts["late"]),
                str(one.counts["cancelled"]),
                str(one.counts["lost"]),
                f"{len(one.wrong)} ({one.checked})",
                f"{one.goodput:.1f}",
                _number(one.ratio, 2),
                _number(1e3 * one.latency(0.5), 1),
                _number(1e3 * one.latency(0.99), 1),
                _number(1e3 * one.longest_refusal, 1),
                _number(math.nan if one.normal_after is None else one.normal_after, 1),
            ]
        )
    return rows


def _server(results: Sequence[Result]) -> list[list[str]]:
    """Return the rows of the table of resources, the first with the headings."""
    rows = [["run", "peak/s", "server CPU", "clients' CPU", "sent late (p99), ms", "memory, MiB"]]
    for one in results:
        before, after = (usage.resident / _MEBIBYTE for usage in (one.before, one.after))
        rows.append(
            [
                one.name,
                _number(one.peak or math.nan, 1),
                f"{one.server_cpu:.2f} cores",
                f"{one.calls.cpu:.2f} cores",
                f"{1e3 * one.lag:.1f}",
                f"{before:.0f} → {after:.0f}",
            ]
        )
    return rows


def _number(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def _list(lines: Sequence[str]) -> str:
    return "\n".join(f"- {line}" for line in lines)


def _table(rows: list[list[str]]) -> str:
    head, *body = rows
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *body]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _html_list(lines: Sequence[str]) -> str:
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>" if lines else ""


def _html_table(rows: list[list[str]]) -> str:
    head, *body = rows
    parts = ["<table><tr>", *(f"<th>{html.escape(cell)}</th>" for cell in head), "</tr>"]
    for row in body:
        parts += ["<tr>", *(f"<td>{html.escape(cell)}</td>" for cell in row), "</tr>"]
    return "".join([*parts, "</table>"])


def _plot(results: Sequence[Result]) -> str:
    """Return latency and goodput against the offered rate as SVG; a note without matplotlib."""
    try:
        from matplotlib.backends.backend_svg import FigureCanvasSVG  # noqa: PLC0415
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ImportError:
        return "<p>The plot needs matplotlib, which the <code>plot</code> extra installs.</p>"
    shown = sorted((one for one in results if one.calls.all), key=lambda one: one.rate)
    rates = [one.rate for one in shown]
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    left = figure.add_subplot()
    for share, style in ((0.5, "o-"), (0.99, "s--")):
        left.plot(rates, [1e3 * one.latency(share) for one in shown], style, label=f"p{100 * share:g}")
    left.set(xlabel="offered calls/s", ylabel="latency of accepted calls, ms", yscale="log")
    right = left.twinx()
    right.plot(rates, [one.goodput for one in shown], "^:", color="tab:green", label="goodput")
    right.set(ylabel="goodput, calls/s", ylim=(0, None))
    figure.legend(loc="outside upper center", ncols=3)
    text = io.StringIO()
    FigureCanvasSVG(figure).print_svg(text)  # type: ignore[no-untyped-call]
    return text.getvalue().partition("?>")[2].partition(">")[2]  # without XML and DOCTYPE lines
