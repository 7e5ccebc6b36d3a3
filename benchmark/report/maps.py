"""Figures of hard cases: the map, the agent's past and future, and the forecasts of each model."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmark.hard_cases import CaseForecast, HardCase
from benchmark.report.canvas import FRAME, Style, grid, plain
from benchmark.requests import crop, raster_message
from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab_forecast.plot import GROUND, INK, draw_map
from model.arrays import Floats

_PANELS_A_ROW = 5
_PANEL, _LARGE_PANEL = 2.75, 3.8
"""Size of a panel in inches; large panels if few are in a row."""
_MARGIN_M = 12.0
_MIN_VIEW_M = 50.0
_MAX_RANGE_M = 90.0
"""Range around the agent that the view covers; forecasts may leave it, as they would shrink the rest."""
_SCALE_M = 10
_MIN_WEIGHT = 0.005


def case_map(case: HardCase, styles: Mapping[str, Style]) -> Figure:
    """Draw the most likely trajectories of all models, and in a panel for each model its modes.

    Args:
        case: the hard case.
        styles: styles of its models, by ``name@version``.
    """
    count = 1 + len(case.forecasts)
    size = _PANEL if count >= _PANELS_A_ROW else _LARGE_PANEL
    figure, panels = grid(count, _PANELS_A_ROW, size, size)
    low, high = _view(case)
    request = PredictRequest(scene_raster=raster_message(crop(case.raster, np.stack([low, high]))))
    for axes in panels:
        _ground(axes, request, low, high)
        _agent(axes, case)
    for key, forecast in case.forecasts.items():
        _most_likely(panels[0], case, forecast, styles[key])
    panels[0].set_title("all, most likely", fontsize=9, color=INK)
    _scale(panels[0], low, high)
    for axes, (key, forecast) in zip(panels[1:], case.forecasts.items(), strict=True):
        _modes(axes, case, forecast, styles[key])
        _most_likely(axes, case, forecast, styles[key])
        title = f"{plain(key)}\nFDE {forecast.fde_6s_m:.1f} m"
        axes.set_title(title, fontsize=8.5, color=INK)
    return figure


def _view(case: HardCase) -> tuple[Floats, Floats]:
    """Return lower left and upper right of a square view: [2] each, m."""
    now = case.history[-1]
    paths = [forecast.most_likely for forecast in case.forecasts.values()]
    points = np.concatenate([case.history, case.truth, *paths])
    points = points[np.hypot(*(points - now).T) <= _MAX_RANGE_M]
    low, high = points.min(axis=0), points.max(axis=0)
    half = max(float((high - low).max()) + 2 * _MARGIN_M, _MIN_VIEW_M) / 2
    middle = (low + high) / 2
    return middle - half, middle + half


def _ground(axes: Axes, request: PredictRequest, low: Floats, high: Floats) -> None:
    """Draw map and frame of a panel, and set its view."""
    axes.set_facecolor(GROUND)
    draw_map(axes, request)
    axes.set_aspect("equal")
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color(FRAME)


def _agent(axes: Axes, case: HardCase) -> None:
    """Draw the other agents, history and truth."""
    axes.plot(*case.others.T, "o", color="#9aa3ac", markersize=3.5, zorder=2)
    axes.plot(*case.history.T, "-", color=INK, linewidth=2.2, zorder=4)
    axes.plot(*case.history[-1], "o", color=INK, markersize=6, zorder=7)
    axes.plot(*_from_now(case, case.truth).T, color=INK, linestyle=(0, (1.5, 1)), linewidth=1.8, zorder=5)
    axes.plot(*case.truth[-1], "X", color=INK, markersize=6.5, markeredgecolor="white", zorder=7)


def _most_likely(axes: Axes, case: HardCase, forecast: CaseForecast, style: Style) -> None:
    path = _from_now(case, forecast.most_likely)
    axes.plot(*path.T, color=style.color, linestyle=style.line, linewidth=2.3, zorder=6)
    axes.plot(*path[-1], color=style.color, marker=style.marker, markersize=5.5, zorder=6)


def _modes(axes: Axes, case: HardCase, forecast: CaseForecast, style: Style) -> None:
    """Draw modes, the more likely the stronger."""
    heaviest = forecast.weights.max()
    for weight, mode in zip(forecast.weights, forecast.modes, strict=True):
        if weight > _MIN_WEIGHT:
            alpha = 0.15 + 0.6 * float(weight / heaviest)
            axes.plot(*_from_now(case, mode).T, color=style.color, alpha=alpha, linewidth=1.1, zorder=3)


def _from_now(case: HardCase, path: Floats) -> Floats:
    """Return a path from the agent's present position: [T, 2] → [T + 1, 2]."""
    return np.concatenate([case.history[-1:], path])


def _scale(axes: Axes, low: Floats, high: Floats) -> None:
    """Draw a scale bar of ten metres."""
    x, y = low + 0.05 * (high - low)
    axes.plot([x, x + _SCALE_M], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt", zorder=8)
    axes.annotate(
        f"{_SCALE_M} m",
        (x + _SCALE_M / 2, y),
        xytext=(0, 3),
        textcoords="offset points",
        ha="center",
        fontsize=7.5,
        color=INK,
        zorder=8,
    )
