"""HTML page of a report: one file without scripts and external resources."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from benchmark.hard_cases import HardCase
from benchmark.report import plots
from benchmark.report.canvas import Style, png, styles, svg
from benchmark.report.maps import case_map
from benchmark.results import BenchmarkResults
from benchmark.tables import left_out, tables
from model.evaluation.tables import Table

REPORT_FILE: Final = "report.html"
_TEMPLATE: Final = "page.html.j2"


@dataclass(frozen=True)
class Picture:
    """A figure of the page."""

    title: str
    source: str
    """Data URL."""
    alternative: str
    """Alternative text."""
    caption: str


def write_page(results: BenchmarkResults, cases: Sequence[HardCase], folder: Path) -> Path:
    """Write ``report.html``.

    Args:
        results: results for tables and curves.
        cases: hard cases to draw; may be empty.
        folder: an existing folder.

    Returns:
        The file.

    Raises:
        OSError: the file cannot be written.
    """
    environment = Environment(
        loader=PackageLoader("benchmark.report", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    shown = styles(dict.fromkeys([*(model.key for model in results.models), *_drawn(cases)]))
    page = environment.get_template(_TEMPLATE).render(
        results=results,
        facts=_facts(results),
        models=_models(results),
        tables=tables(results),
        left_out=left_out(results),
        curves=_curves(results),
        cases=[_case(case, shown) for case in cases],
    )
    file = folder / REPORT_FILE
    file.write_text(page, encoding="utf-8")
    return file


def _facts(results: BenchmarkResults) -> dict[str, str]:
    """Return the settings of the run by name."""
    return {
        "Endpoint": results.endpoint,
        "Program": f"cab-forecast {results.version}",
        "Protocol of the inputs": results.protocol.value,
        "Data": f"{results.data}, split {results.split}",
        "Pairs": f"{results.pairs}" if results.limit is None else f"the first {results.pairs} only",
        "Samples a pair": f"{results.samples}",
        "Draws a step for calibration": f"{results.draws}",
        "Seed": f"{results.seed}",
        "Plan": results.plan,
    }


def _models(results: BenchmarkResults) -> Table:
    rows = tuple((model.key, model.protocol, model.trained_on) for model in results.models)
    note = "Protocol: that of the training data."
    return Table("Models", note, ("model", "protocol", "trained on"), rows)


def _curves(results: BenchmarkResults) -> list[Picture]:
    """Return the curves that have figures."""
    names = ", ".join(model.key for model in results.models)
    made = (
        (
            plots.error_by_horizon(results),
            "Error by horizon",
            "Two panels of lines: ADE and FDE of the most likely trajectory at 1 to 6 s",
            "On a logarithmic scale. Table 1 has the figures.",
        ),
        (
            plots.calibration(results),
            "Calibration",
            "One panel per model: share of the truth inside the 50, 90 and 99 % regions at 1 to 6 s",
            "Below the dashed line: overconfident; above it: underconfident. Table 5 has the figures.",
        ),
        (
            plots.consistency(results),
            "Dispersion and convergence",
            "Bars per model: dispersion in three forms, and convergence to three ranges",
            "Table 2 has the figures.",
        ),
    )
    return [
        Picture(title, _data_url(svg(figure), "image/svg+xml"), f"{shows}. Of {names}.", caption)
        for figure, title, shows, caption in made
        if isinstance(figure, Figure)
    ]


def _case(case: HardCase, shown: Mapping[str, Style]) -> Picture:
    best_first = sorted(case.forecasts.items(), key=lambda one: one[1].fde_6s_m)
    errors = "; ".join(f"{key} {forecast.fde_6s_m:.1f} m" for key, forecast in best_first)
    return Picture(
        f"{case.scene}, agent {case.agent}, frame {case.frame}",
        _data_url(png(case_map(case, shown)), "image/png"),
        f"Map around agent {case.agent} in scene {case.scene}, frame {case.frame}: its past, its true "
        f"future, and the forecasts of {', '.join(case.forecasts)}.",
        f"FDE at 6 s: Kalman filter {case.mismatch_m:.1f} m; {errors}.",
    )


def _drawn(cases: Sequence[HardCase]) -> list[str]:
    return [key for case in cases for key in case.forecasts]


def _data_url(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
