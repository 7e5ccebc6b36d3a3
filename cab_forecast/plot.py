"""A picture of a scene and its forecasts."""

from os import PathLike

import numpy as np
import numpy.typing as npt

try:
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        'pictures need matplotlib: pip install "cab-forecast[plot]"', name=error.name
    ) from error

from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest, PredictResponse
from cab_forecast.forecast import Forecast, Status, forecasts
from cab_forecast.names import model_name, protocol_name, type_name
from cab_forecast.plot_agents import (
    ELLIPSE_SECONDS,
    MODES_WITH_ELLIPSES,
    MOST_MODES,
    SMALLEST_WEIGHT,
    color_of,
    draw_agent,
    draw_modes,
    shown_modes,
)
from cab_forecast.plot_map import draw_map
from cab_forecast.plot_style import GROUND, INK, TYPE_COLORS, WRONG

DOTS_PER_INCH = 150
LONG_SIDE = 11.0
"""Inches of the picture's map on its longer side."""
_SHORTEST_SIDE = 5.0
_MARGIN = 6.0
"""m kept free around what is drawn."""
_LEAST_VIEW = 40.0
_LARGEST_VIEW = 240.0
"""m; agents farther from the others are left outside rather than making everything tiny."""
_MOST_LABELS = 24

_Floats = npt.NDArray[np.float64]


def plot(request: PredictRequest, response: PredictResponse, path: str | PathLike[str]) -> None:
    """Draws the map, the agents with their histories, and the likely modes of their forecasts.

    Args:
        request: what the server was asked.
        response: what it answered.
        path: file to write; its ending says which format (png, svg, pdf, …).

    Raises:
        ValueError: no agent has a state, the map or the response contradicts itself, or the ending is of
            no format that matplotlib knows.
        OSError: the file cannot be written.
    """
    agents = [agent for agent in request.agents if agent.states]
    if not agents:
        raise ValueError("there is nothing to draw: no agent has a state")
    views = forecasts(response)
    low, high = _view(agents, views)
    figure, axes = _canvas(high - low)
    draw_map(axes, request)
    for agent in agents:
        view = views.get(agent.id)
        wrong = view is not None and view.status is Status.INVALID
        draw_agent(axes, agent, wrong=wrong, label=len(agents) <= _MOST_LABELS)
        if view is not None and len(view.weights):
            now = agent.states[-1]
            draw_modes(axes, view, np.array([now.x, now.y]), response.time, color_of(agent))
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    _scale_bar(axes, low, high)
    _legend(figure, agents, views)
    _title(axes, response)
    figure.savefig(path, dpi=DOTS_PER_INCH)


def _view(agents: list[Agent], views: dict[str, Forecast]) -> tuple[_Floats, _Floats]:
    """Lower left and upper right of what is shown: [2] each, m."""
    points = [np.array([(state.x, state.y) for state in agent.states]) for agent in agents]
    points += [_reach(view) for view in views.values() if len(view.weights)]
    middle = np.median([track[-1] for track in points[: len(agents)]], axis=0)
    every = np.concatenate(points)
    near = every[(np.abs(every - middle) <= _LARGEST_VIEW / 2).all(axis=1)]
    if not len(near):  # everyone is far from everyone
        near = every
    low, high = near.min(axis=0) - _MARGIN, near.max(axis=0) + _MARGIN
    missing = np.maximum(_LEAST_VIEW - (high - low), 0.0) / 2
    return low - missing, high + missing


def _reach(view: Forecast) -> _Floats:
    """Corners of the boxes around the 1-σ ellipses of the modes shown: [·, 2], m."""
    modes = shown_modes(view)
    variances = view.covariances[modes][..., [0, 1], [0, 1]]
    spread = np.sqrt(variances.clip(min=0.0))
    return np.concatenate([view.means[modes] - spread, view.means[modes] + spread]).reshape(-1, 2)


def _canvas(size: _Floats) -> tuple[Figure, Axes]:
    """An empty picture whose map has the proportions of the ground, within reason."""
    inches = np.maximum(LONG_SIDE * size / size.max(), _SHORTEST_SIDE)
    figure = Figure(
        figsize=(float(inches[0]), float(inches[1]) + 1.2), layout="constrained", facecolor="white"
    )
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal", adjustable="box")
    axes.set_facecolor(GROUND)
    axes.tick_params(colors=INK, labelsize=8, length=3)
    axes.set_xlabel("x, m", fontsize=8.5, color=INK)
    axes.set_ylabel("y, m", fontsize=8.5, color=INK)
    axes.ticklabel_format(useOffset=False, style="plain")
    for spine in axes.spines.values():
        spine.set_color("#b8bec4")
    return figure, axes


def _scale_bar(axes: Axes, low: _Floats, high: _Floats) -> None:
    """A bar of a round number of metres, about a seventh of the picture wide."""
    wanted = float(high[0] - low[0]) / 7
    length = max(meters for meters in (1, 2, 5, 10, 20, 50, 100) if meters <= max(wanted, 1.0))
    start = low + 0.03 * (high - low)
    axes.plot(
        [start[0], start[0] + length],
        [start[1]] * 2,
        color=INK,
        linewidth=3,
        solid_capstyle="butt",
        zorder=10,
    )
    axes.annotate(
        f"{length} m",
        (start[0] + length / 2, start[1]),
        xytext=(0, 4),
        textcoords="offset points",
        ha="center",
        fontsize=8.5,
        color=INK,
        zorder=10,
    )


def _legend(figure: Figure, agents: list[Agent], views: dict[str, Forecast]) -> None:
    seen = {type_name(agent.type) for agent in agents}
    kinds = {name: color for name, color in TYPE_COLORS.items() if name in seen}
    if any(view.status is Status.INVALID for view in views.values()):
        kinds["invalid: no forecast"] = WRONG
    squares = [
        Line2D([], [], color=color, label=name, marker="s", linestyle="none", markersize=7)
        for name, color in kinds.items()
    ]
    horizons = ", ".join(f"{seconds:g}" for seconds in ELLIPSE_SECONDS)
    modes = f"modes of weight ≥ {SMALLEST_WEIGHT:g}, at most {MOST_MODES}; fainter is less likely"
    spreads = f"1 σ (filled) and 2 σ at {horizons} s, likeliest {MODES_WITH_ELLIPSES} modes"
    lines = [
        Line2D([], [], color=INK, linewidth=1.6, alpha=0.5, marker=".", label="observed"),
        Line2D([], [], color=INK, linewidth=2, marker="o", markersize=3.5, label=modes),
        Line2D([], [], color=INK, linewidth=0.9, linestyle=(0, (4, 2)), label=spreads),
    ]
    figure.legend(
        handles=squares + lines,
        loc="outside lower center",
        ncols=3 if len(squares) <= 3 else 4,
        fontsize=8,
        frameon=False,
        labelcolor=INK,
    )


def _title(axes: Axes, response: PredictResponse) -> None:
    model = response.model
    axes.set_title(
        f"{model_name(model)}  ·  {protocol_name(model.protocol)} protocol",
        loc="left",
        fontsize=13,
        fontweight="bold",
        color=INK,
    )
    axes.set_title(
        f"{response.steps * response.step:g} s ahead for {len(response.forecasts)} agents; nominal outlines",
        loc="right",
        fontsize=8.5,
        color=INK,
    )
