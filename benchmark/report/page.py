"""The page: everything in one file, which needs no script and asks nothing of the network."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from benchmark.hard import HardCase
from benchmark.report import plots
from benchmark.report.canvas import Style, png, styles, svg
from benchmark.report.maps import case_map
from benchmark.results import Results
from benchmark.tables import left_out, tables
from model.evaluation.text_tables import Table

REPORT_FILE = "report.html"
_TEMPLATE = "page.html.j2"


@dataclass(frozen=True)
class Picture:
    """A picture as a page holds it."""

    title: str
    source: str
    """Data URL."""
    alternative: str
    """What it shows, for those who do not see it."""
    caption: str


def write_page(results: Results, cases: Sequence[HardCase], folder: Path) -> Path:
    """Writes ``report.html``.

    Args:
        results: tables and curves are of these.
        cases: hard cases to draw; may be none.
        folder: where to; it exists.

    Returns:
        The file.

    Raises:
        OSError: it cannot be written.
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


def _facts(results: Results) -> dict[str, str]:
    """What was asked, and of whom."""
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


def _models(results: Results) -> Table:
    rows = tuple((model.key, model.protocol, model.trained_on) for model in results.models)
    note = "What was judged; protocol: of the states that it was trained on."
    return Table("Models", note, ("model", "protocol", "trained on"), rows)


def _curves(results: Results) -> list[Picture]:
    """Those that there are figures for."""
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
            "A panel a model: share of the truth inside the 50, 90 and 99 % regions at 1 to 6 s",
            "Below its dashed line a model is too sure, above it not sure enough. Table 5 has the figures.",
        ),
        (
            plots.consistency(results),
            "Dispersion and convergence",
            "Bars a model: dispersion in three forms, and convergence to three ranges",
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
        f"Map around agent {case.agent} in scene {case.scene}, frame {case.frame}: its past, where it went, "
        f"and the forecasts of {', '.join(case.forecasts)}.",
        f"The Kalman filter misses by {case.mismatch_m:.1f} m. FDE at 6 s: {errors}.",
    )


def _drawn(cases: Sequence[HardCase]) -> list[str]:
    return [key for case in cases for key in case.forecasts]


def _data_url(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
