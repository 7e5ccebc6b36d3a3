"""Curves and bars of a benchmark's results; None where there are no figures."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from benchmark.report.canvas import REFERENCE, Style, dress, empty, grid, plain, styles
from benchmark.results import BenchmarkModelResult, BenchmarkResults
from cab_forecast.plot import INK
from model.arrays import Floats
from model.evaluation.published import published_figures
from model.forecaster import Protocol
from model.metrics.consistency import RANGES_M
from model.metrics.displacement import HORIZONS_S

_PAPER = {"cab": (0, (5.0, 2.0)), "trajectron": (0, (2.0, 2.0))}
"""Models of the paper that are drawn for comparison, with their dashes."""
_PERCENTS = {50: "#0072b2", 90: "#d55e00", 99: "#009e73"}
_SHADES = ("#a6cbe2", "#4b93bf", "#0b4f7c")
_METERS = (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)
_PANELS_A_ROW = 4


def error_by_horizon(results: BenchmarkResults) -> Figure | None:
    """Plot ADE and FDE of the most likely trajectory at 1 … 6 s, one line per model.

    By the paper protocol, the paper's CAB and Trajectron++ are added.
    """
    models = _having(results, [f"ade_ml_{second}s_m" for second in HORIZONS_S])
    if not models:
        return None
    figure = empty(11.5, 5.0)
    lines: dict[str, Line2D] = {}
    found = styles(model.key for model in results.models)
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), ("ade", "fde"), strict=True):
        names = [f"{kind}_ml_{second}s_m" for second in HORIZONS_S]
        for model in models:
            lines[model.label(results.protocol)] = _curve(axes, model.metrics, names, found[model.key])
        if results.protocol is Protocol.PAPER:
            for name, dashes in _PAPER.items():
                lines[f"{name}, in the paper"] = _curve(
                    axes, published_figures(name), names, Style(INK, dashes, "")
                )
        _by_horizon(axes, f"{kind.upper()} of the most likely trajectory, m")
        # Errors at 1 s and at 6 s differ by orders of magnitude
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(FixedLocator(_METERS))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.tick_params(labelleft=True)
    names = [plain(name) for name in lines]
    figure.legend(
        list(lines.values()), names, loc="outside right upper", fontsize=9, frameon=False, handlelength=3.5
    )
    return figure


def calibration(results: BenchmarkResults) -> Figure | None:
    """Plot the share of the truth inside the 50, 90 and 99 % regions at 1 … 6 s, one panel per model."""
    models = _having(
        results, [f"inside_{percent}_{second}s" for percent in _PERCENTS for second in HORIZONS_S]
    )
    if not models:
        return None
    figure, panels = grid(len(models), _PANELS_A_ROW, 2.85, 2.3)
    for axes, model in zip(panels, models, strict=True):
        for percent, color in _PERCENTS.items():
            names = [f"inside_{percent}_{second}s" for second in HORIZONS_S]
            axes.axhline(percent / 100, color=color, linewidth=1.0, linestyle=(0, (4, 2)))
            _curve(axes, model.metrics, names, Style(color, "-", "o"))
        _by_horizon(axes, model.label(results.protocol).replace(" (", "\n("), size=8.5)
        axes.set_ylim(0.0, 1.04)
        axes.set_yticks([0.0, 0.5, 0.9, 0.99], ["0", "50", "90", "99"])
    handles = [Line2D([], [], color=color, marker="o", markersize=4) for color in _PERCENTS.values()]
    handles.append(Line2D([], [], color=REFERENCE, linestyle=(0, (4, 2))))
    observed = [f"observed in the {percent} % region, %" for percent in _PERCENTS]
    figure.legend(
        handles, [*observed, "nominal"], loc="outside lower center", ncols=4, fontsize=9, frameon=False
    )
    return figure


def consistency(results: BenchmarkResults) -> Figure | None:
    """Plot bars of dispersion in its three forms, and of convergence to three ranges.

    By the paper protocol, the paper's figures are added as strokes.
    """
    spreads = {"std": "dispersion_std_m", "mean": "dispersion_mean_m", "rms": "dispersion_rms_m"}
    ranges = {f"C({range_m:g} m)": f"convergence_{range_m:g}m_s" for range_m in RANGES_M}
    models = _having(results, [*spreads.values(), *ranges.values()])
    if not models:
        return None
    figure = empty(11.5, 1.4 + 0.42 * len(models))
    left, right = figure.subplots(1, 2, sharey=True)
    _bars(left, results, models, spreads, "Dispersion D, m (lower is better)")
    _bars(right, results, models, ranges, "Convergence C, s (higher is better)")
    left.set_yticks(range(len(models)), [plain(model.label(results.protocol)) for model in models])
    left.set_ylim(len(models) - 0.4, -0.6)
    return figure


def _bars(
    axes: Axes,
    results: BenchmarkResults,
    models: Sequence[BenchmarkModelResult],
    columns: Mapping[str, str],
    title: str,
) -> None:
    height = 0.8 / len(columns)
    for place, (name, metric) in enumerate(columns.items()):
        at = np.arange(len(models)) + (place - (len(columns) - 1) / 2) * height
        axes.barh(at, _figures(models, metric), height, color=_SHADES[place], label=name)
        if results.protocol is Protocol.PAPER:
            theirs = np.array([published_figures(model.name).get(metric, math.nan) for model in models])
            axes.vlines(theirs, at - height / 2, at + height / 2, color=INK)
    handles, names = axes.get_legend_handles_labels()
    if results.protocol is Protocol.PAPER:
        handles, names = [*handles, Line2D([], [], color=INK)], [*names, "in the paper"]
    dress(axes)
    axes.grid(visible=False, axis="y")
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.legend(
        handles,
        names,
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        borderaxespad=2.5,
        ncols=4,
        fontsize=8.5,
        handlelength=1.2,
        columnspacing=1.2,
        frameon=False,
    )


def _curve(axes: Axes, figures: Mapping[str, float], names: Sequence[str], style: Style) -> Line2D:
    """Draw the figures of these names, one for each of 1 … 6 s, as a curve, and return it."""
    values = [figures.get(name, math.nan) for name in names]
    (line,) = axes.plot(
        HORIZONS_S,
        values,
        color=style.color,
        linestyle=style.line,
        marker=style.marker,
        markersize=4.5,
        linewidth=1.5,
    )
    return line


def _by_horizon(axes: Axes, title: str, size: float = 10) -> None:
    dress(axes)
    axes.set_title(plain(title), fontsize=size, color=INK, loc="left")
    axes.set_xticks(HORIZONS_S, [f"{second} s" for second in HORIZONS_S])


def _figures(models: Sequence[BenchmarkModelResult], metric: str) -> Floats:
    return np.array([model.metrics.get(metric, math.nan) for model in models], dtype=np.float64)


def _having(results: BenchmarkResults, metrics: Sequence[str]) -> list[BenchmarkModelResult]:
    """Return the models with any of the metrics."""
    return [
        model
        for model in results.models
        if any(math.isfinite(model.metrics.get(metric, math.nan)) for metric in metrics)
    ]
