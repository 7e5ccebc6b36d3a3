"""Plots of explanations: Shapley values beside the forecasts (as in Ben-Younes et al. 2022, figure 4)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Final

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cab.forecast.v1.explanation_service_pb2 import AgentExplanation, ExplainResponse
from cab.forecast.v1.prediction_service_pb2 import (
    FORECAST_STATUS_INVALID,
    Agent,
    PredictRequest,
    PredictResponse,
)
from cab_forecast.explanations import PARTS
from cab_forecast.forecast import Forecast, forecasts, model_name
from cab_forecast.plot import DOTS_PER_INCH, GROUND, INK, color_of, draw_agent, draw_map, draw_modes

MAX_ROWS: Final = 6
"""Maximum number of agents in a plot."""
_NEIGHBORS: Final = 4
_MARGIN: Final = 8.0
_MIN_VIEW: Final = 40.0
_WIDTH, _BARS, _HEIGHT = 3.0, 2.0, 3.0
"""Inches of a scene's width, of the bars beside it, and of a row."""
_LABELS: Final = {"state": "own state", "map": "map", "neighbors": "neighbours"}
_COLORS: Final = {"state": "#0072b2", "map": "#e69f00", "neighbors": "#009e73"}
"""Colours of Okabe and Ito, which colour-blind people tell apart."""
_NEIGHBOR_COLOR: Final = "#9ccfbf"

_Floats = npt.NDArray[np.float64]
_Bar = tuple[str, float, float, str]
"""Label, value in m, standard error in m, colour."""


@dataclass(frozen=True)
class Explained:
    """The forecasts of one scene by one model, and their explanations."""

    request: PredictRequest
    response: PredictResponse
    explanations: ExplainResponse


@dataclass(frozen=True)
class _Panel:
    """One agent, as one model forecasts it."""

    request: PredictRequest
    time: float
    agent: Agent
    forecast: Forecast
    explanation: AgentExplanation


def plot_explanations(
    rows: Sequence[Sequence[Explained]], path: str | PathLike[str], labels: Sequence[str] = ()
) -> None:
    """Plot explained forecasts: a row for each agent, a column for each model.

    Args:
        rows: scenes, each as forecast by the same models in the same order; each explained agent gets a row,
            the first ``MAX_ROWS`` of all.
        path: file to write; its suffix determines the format (png, svg, pdf, …).
        labels: titles of the columns; empty: the models' names and versions.

    Raises:
        ValueError: no forecast is explained, a response contradicts itself, or matplotlib does not know the
            format.
        OSError: the file cannot be written.
    """
    panels = [row for scene in rows for row in _panels(scene)][:MAX_ROWS]
    if not panels:
        raise ValueError("there is nothing to plot: no forecast is explained")
    columns = len(panels[0])
    figure = Figure(
        figsize=(columns * (_WIDTH + _BARS), len(panels) * _HEIGHT + 0.5),
        layout="constrained",
        facecolor="white",
    )
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(panels), 2 * columns, squeeze=False, width_ratios=[_WIDTH, _BARS] * columns)
    for number, row in enumerate(panels):
        low, high = _view(row)
        shown = [bar for panel in row for bar in _shown(panel.explanation)]
        span = _span(shown)
        places = max(len(_shown(panel.explanation)) for panel in row)
        for column, panel in enumerate(row):
            scene, bars = grid[number, 2 * column], grid[number, 2 * column + 1]
            _draw_scene(scene, panel, low, high)
            _draw_bars(bars, _shown(panel.explanation), span, places)
            if number == 0:
                title = labels[column] if labels else model_name(panel.explanation.model)
                scene.set_title(title, loc="left", fontsize=10, fontweight="bold", color=INK)
    figure.supxlabel(
        "m by which own state, map and neighbours bring the most likely end point nearer to where it is with "
        "everything present (Shapley values, bars: ± 1 standard error)",
        fontsize=8.5,
        color=INK,
    )
    figure.savefig(path, dpi=DOTS_PER_INCH)


def _panels(scene: Sequence[Explained]) -> list[list[_Panel]]:
    """Return the rows of a scene: for each agent that all models forecast, its panels."""
    views = [forecasts(one.response) for one in scene]
    told: list[Mapping[str, AgentExplanation]] = [
        {
            each.agent_id: each
            for each in one.explanations.explanations
            if each.status != FORECAST_STATUS_INVALID
        }
        for one in scene
    ]
    return [
        [
            _Panel(one.request, one.response.time, agent, view[agent.id], explanation[agent.id])
            for one, view, explanation in zip(scene, views, told, strict=True)
        ]
        for agent in scene[0].request.agents
        if agent.states
        and all(agent.id in explanation for explanation in told)
        and all(agent.id in view and len(view[agent.id].weights) for view in views)
    ]


def _view(row: Sequence[_Panel]) -> tuple[_Floats, _Floats]:
    """Return the corners of the view of an agent, the same for all models: [2] each, m."""
    points = []
    for panel in row:
        likely = panel.forecast.ranked_modes[0]
        points += [panel.forecast.means[likely], _base(panel.explanation)[None]]
        points.append(np.array([(panel.agent.states[-1].x, panel.agent.states[-1].y)]))
    every = np.concatenate(points)
    low, high = every.min(axis=0) - _MARGIN, every.max(axis=0) + _MARGIN
    half = max(float((high - low).max()), _MIN_VIEW) / 2
    middle = (low + high) / 2
    return middle - half, middle + half


def _base(explanation: AgentExplanation) -> _Floats:
    return np.array([explanation.base_point.x, explanation.base_point.y])


def _draw_scene(axes: Axes, panel: _Panel, low: _Floats, high: _Floats) -> None:
    axes.set_aspect("equal", adjustable="box")
    axes.set_facecolor(GROUND)
    draw_map(axes, panel.request)
    for agent in panel.request.agents:
        if agent.states:
            draw_agent(axes, agent, invalid=False, label=False)
    now = panel.agent.states[-1]
    start = np.array([now.x, now.y])
    draw_modes(axes, panel.forecast, start, panel.time, color_of(panel.agent))
    end = panel.explanation.end_point
    base = _base(panel.explanation)
    axes.plot([base[0], end.x], [base[1], end.y], ":", color=INK, linewidth=1.0, zorder=8)
    axes.plot(*base, "x", color=INK, markersize=6, zorder=8)
    axes.plot(end.x, end.y, "*", color="white", markeredgecolor=INK, markersize=9, zorder=9)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlabel(panel.agent.id, fontsize=8, color=INK)


def _shown(explanation: AgentExplanation) -> list[_Bar]:
    """Return the bars, from above."""
    bars = []
    for part in PARTS:
        value = getattr(explanation, part)
        bars.append((_LABELS[part], value.nearer, value.nearer_error, _COLORS[part]))
    for neighbor in explanation.by_neighbor[:_NEIGHBORS]:
        if neighbor.value.nearer:
            value = neighbor.value
            bars.append((neighbor.agent_id[:12], value.nearer, value.nearer_error, _NEIGHBOR_COLOR))
    return bars


def _span(bars: Sequence[_Bar]) -> tuple[float, float]:
    """Return the range of values that all bars share, with their errors, m."""
    low = min(0.0, *(value - error for _, value, error, _ in bars))
    high = max(0.1, *(value + error for _, value, error, _ in bars))
    margin = 0.05 * (high - low)
    return low - margin, high + margin


def _draw_bars(axes: Axes, bars: Sequence[_Bar], span: tuple[float, float], most: int) -> None:
    """Draw bars with room for as many as the row's fullest panel has."""
    places = np.arange(len(bars))
    axes.barh(
        places,
        [value for _, value, _, _ in bars],
        xerr=[error for _, _, error, _ in bars],
        color=[color for _, _, _, color in bars],
        error_kw={"elinewidth": 0.8, "ecolor": INK},
        height=0.7,
    )
    axes.axvline(0, color=INK, linewidth=0.8)
    axes.set_yticks(places, [label for label, _, _, _ in bars], fontsize=7.5, color=INK)
    axes.set_ylim(most - 0.4, -0.6)
    axes.set_xlim(*span)
    axes.tick_params(colors=INK, labelsize=7.5, length=2)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
