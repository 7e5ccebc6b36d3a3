"""Plot of a scene and its forecasts."""

import math
from os import PathLike
from typing import Final

import numpy as np
import numpy.typing as npt

try:
    from matplotlib import patheffects
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import to_rgba
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Circle, Ellipse, Polygon
    from matplotlib.transforms import Affine2D
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        'plots need matplotlib: pip install "cab-forecast[plot]"', name=error.name
    ) from error

from cab.forecast.v1.bounds import PATCH_PIXELS
from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest, PredictResponse
from cab_forecast.forecast import Forecast, Status, forecasts, model_name, protocol_name, type_name
from cab_forecast.layers import Layers, decode_layers
from cab_forecast.maneuvers import current_heading
from cab_forecast.requests import PIXELS_PER_METER

DOTS_PER_INCH = 150
LONG_SIDE = 11.0
"""Longer side of the map, inches."""
_MIN_SIDE = 5.0
_MARGIN = 6.0
"""Free margin around the contents, m."""
_MIN_VIEW = 40.0
"""Size of the view at least, m."""
_MAX_VIEW = 240.0
"""Size of the area whose agents and forecasts the view shows, m; others are left out, so that these do not
become tiny."""
_MAX_LABELS = 24
ELLIPSE_SECONDS = (2.0, 4.0, 6.0)
"""Horizons at which positions are marked and ellipses drawn."""
MIN_WEIGHT = 0.05
MAX_MODES = 5
MODES_WITH_ELLIPSES = 2

GROUND: Final = "#eef0ec"
DRIVEABLE: Final = "#d3d7dd"
ROAD_DIVIDER: Final = "#d99a1c"
LANE_DIVIDER: Final = "#ffffff"
INK: Final = "#22303c"
INVALID_COLOR: Final = "#8c8c8c"

TYPE_COLORS: Final = {
    "vehicle": "#1f5fae",
    "pedestrian": "#c8374a",
    "cyclist": "#1d8a4b",
    "unknown": "#7b4ba6",
    "unspecified": "#7b4ba6",
}
NOMINAL_SIZES: Final = {
    "vehicle": (4.6, 1.9),
    "cyclist": (1.8, 0.7),
}
"""Length and width, m, of the types drawn as boxes. The contract has no sizes of agents."""
NOMINAL_RADIUS: Final = 0.45
"""Radius, m, of the types drawn as discs."""

_PATCH_ORIGIN = (-10 / PIXELS_PER_METER, -50 / PIXELS_PER_METER)
"""Position of a patch's first pixel, m ahead of and to the left of the agent."""

_Floats = npt.NDArray[np.float64]


def plot(request: PredictRequest, response: PredictResponse, path: str | PathLike[str]) -> None:
    """Plot the map, the agents with their histories, and the most likely modes of their forecasts.

    Args:
        request: the request.
        response: its response.
        path: file to write; its suffix determines the format (png, svg, pdf, …).

    Raises:
        ValueError: no agent has a state, the map or the response contradicts itself, or matplotlib does not
            know the format.
        OSError: the file cannot be written.
    """
    agents = [agent for agent in request.agents if agent.states]
    if not agents:
        raise ValueError("there is nothing to plot: no agent has a state")
    views = forecasts(response)
    low, high = _view(agents, views)
    figure, axes = canvas(high - low)
    draw_map(axes, request)
    for agent in agents:
        view = views.get(agent.id)
        invalid = view is not None and view.status is Status.INVALID
        draw_agent(axes, agent, invalid=invalid, label=len(agents) <= _MAX_LABELS)
        if view is not None and len(view.weights):
            now = agent.states[-1]
            draw_modes(axes, view, np.array([now.x, now.y]), response.time, color_of(agent))
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    _scale_bar(axes, low, high)
    _legend(figure, agents, views)
    _title(axes, response)
    figure.savefig(path, dpi=DOTS_PER_INCH)


def draw_map(axes: Axes, request: PredictRequest) -> None:
    """Draw the scene's raster, and the patches of agents that have one and a heading.

    Raises:
        ValueError: the bytes of a map do not fit its size.
    """
    if request.HasField("scene_raster"):
        raster = request.scene_raster
        layers = decode_layers(raster.image, raster.rows, raster.columns)
        _draw_layers(axes, layers, (raster.origin_x, raster.origin_y), raster.pixels_per_meter, Affine2D())
    for agent in request.agents:
        if agent.HasField("map_patch") and agent.states and agent.states[-1].HasField("heading"):
            layers = decode_layers(agent.map_patch.image, PATCH_PIXELS, PATCH_PIXELS)
            _draw_layers(axes, layers, _PATCH_ORIGIN, PIXELS_PER_METER, _to_ground(agent))


def _draw_layers(
    axes: Axes, layers: Layers, origin: tuple[float, float], pixels_per_meter: float, transform: Affine2D
) -> None:
    # A pixel's value belongs to its center: the image extends half a pixel beyond the outer ones.
    (x, y), (rows, columns) = origin, layers.shape[1:]
    half = 0.5 / pixels_per_meter
    extent = (x - half, x + rows / pixels_per_meter - half, y - half, y + columns / pixels_per_meter - half)
    axes.imshow(
        _colors(layers).swapaxes(0, 1),  # rows run along x here, along y in an image
        origin="lower",
        extent=extent,
        transform=transform + axes.transData,
        interpolation="antialiased",
        zorder=0,
    )


def _colors(layers: Layers) -> npt.NDArray[np.float64]:
    """Return an RGBA image of [3, rows, columns] layers, transparent where all are 0: [rows, columns, 4]."""
    image = np.zeros((*layers.shape[1:], 4))
    image[:, :, :3] = to_rgba(DRIVEABLE)[:3]  # otherwise the edges would blend with black
    for layer, color in zip(layers, (DRIVEABLE, ROAD_DIVIDER, LANE_DIVIDER), strict=True):
        image[layer] = to_rgba(color)
    return image


def _to_ground(agent: Agent) -> Affine2D:
    now = agent.states[-1]
    return Affine2D().rotate(now.heading).translate(now.x, now.y)


def color_of(agent: Agent) -> str:
    """Return the color of an agent's type."""
    return TYPE_COLORS[type_name(agent.type)]


def draw_agent(axes: Axes, agent: Agent, *, invalid: bool, label: bool) -> None:
    """Draw an agent at its current position, oriented if its heading is known, and its history.

    Args:
        axes: axes in the ground frame.
        agent: an agent with at least one state.
        invalid: whether its status is INVALID.
        label: whether to write its id.
    """
    color = INVALID_COLOR if invalid else color_of(agent)
    track = np.array([(state.x, state.y) for state in agent.states])
    now = track[-1]
    axes.plot(*track.T, color=color, linewidth=1.6, alpha=0.55, solid_capstyle="round", zorder=4)
    axes.plot(*track[:-1].T, ".", color=color, markersize=2.5, alpha=0.6, zorder=4)
    size, heading = NOMINAL_SIZES.get(type_name(agent.type)), current_heading(agent)
    outline: Circle | Polygon
    if size is None or heading is None:
        outline = Circle((now[0], now[1]), NOMINAL_RADIUS if size is None else size[1] / 2)
    else:
        outline = Polygon(_pointed_box(now, heading, *size), joinstyle="round")
    outline.set(facecolor=color, edgecolor="white", linewidth=0.9, zorder=6)
    axes.add_patch(outline)
    if invalid:
        axes.plot(*now, "x", color="black", markersize=6, zorder=7)
    if label:
        axes.annotate(
            agent.id,
            now,
            xytext=(0, 9),
            textcoords="offset points",
            ha="center",
            fontsize=7.5,
            color=INK,
            zorder=9,
            path_effects=[patheffects.withStroke(linewidth=2.2, foreground="white")],
            clip_on=True,
        )


def draw_modes(axes: Axes, forecast: Forecast, start: _Floats, now: float, color: str) -> None:
    """Draw the shown modes, fainter if less likely, with 1- and 2-σ ellipses for the most likely ones.

    Args:
        axes: axes in the ground frame.
        forecast: a forecast with K ≥ 1 modes.
        start: [2], the current position, m.
        now: seconds since the epoch.
        color: color of the agent.
    """
    marked = marked_steps(forecast, now)
    for rank, mode in enumerate(shown_modes(forecast)):
        share = forecast.weights[mode] / forecast.weights.max()
        strength = 0.2 + 0.8 * share
        means = forecast.means[mode]
        path = np.concatenate([start[None], means])
        axes.plot(*path.T, color=color, linewidth=0.9 + 1.1 * share, alpha=strength, zorder=5)
        axes.plot(*means[marked].T, "o", color=color, markersize=2.2 + share, alpha=strength, zorder=5)
        if rank < MODES_WITH_ELLIPSES:
            for step in marked:
                _draw_ellipses(axes, means[step], forecast.covariances[mode, step], color, share)


def shown_modes(forecast: Forecast) -> npt.NDArray[np.int64]:
    """Return the indices of the modes to draw, the most likely first; that one is always among them."""
    ranked = forecast.ranked_modes[:MAX_MODES]
    likely: npt.NDArray[np.int64] = ranked[forecast.weights[ranked] >= MIN_WEIGHT]
    return likely if len(likely) else ranked[:1]


def marked_steps(forecast: Forecast, now: float) -> list[int]:
    """Return the indices of the steps at ``ELLIPSE_SECONDS``; for shorter forecasts the last step."""
    ahead = forecast.times - now
    steps = [
        int(np.abs(ahead - seconds).argmin()) for seconds in ELLIPSE_SECONDS if seconds <= ahead[-1] + 1e-6
    ]
    return sorted(set(steps)) or [len(ahead) - 1]


def _draw_ellipses(axes: Axes, mean: _Floats, covariance: _Floats, color: str, share: float) -> None:
    variances, directions = np.linalg.eigh(covariance)
    minor, major = np.sqrt(variances.clip(min=0.0))
    angle = math.degrees(math.atan2(directions[1, 1], directions[0, 1]))
    center = (mean[0], mean[1])
    one_sigma = Ellipse(center, 2 * major, 2 * minor, angle=angle)
    one_sigma.set(facecolor=color, alpha=0.11 * share, linewidth=0.0, zorder=2)
    two_sigma = Ellipse(center, 4 * major, 4 * minor, angle=angle, fill=False)
    two_sigma.set(edgecolor=color, alpha=0.45 * share, linewidth=0.7, linestyle=(0, (4, 2)), zorder=3)
    axes.add_patch(one_sigma)
    axes.add_patch(two_sigma)


def _pointed_box(center: _Floats, heading: float, length: float, width: float) -> _Floats:
    """Return the corners of a box with a slightly pointed front, which shows its heading: [5, 2], m."""
    half = np.array([length, width]) / 2
    corners = np.array([(1.0, 0.0), (0.72, 1.0), (-1.0, 1.0), (-1.0, -1.0), (0.72, -1.0)]) * half
    cos, sin = math.cos(heading), math.sin(heading)
    box: _Floats = center + corners @ np.array([[cos, sin], [-sin, cos]])
    return box


def _view(agents: list[Agent], views: dict[str, Forecast]) -> tuple[_Floats, _Floats]:
    """Return the lower left and upper right corner of the view: [2] each, m."""
    now = np.array([(agent.states[-1].x, agent.states[-1].y) for agent in agents])
    near = (np.abs(now - np.median(now, axis=0)) <= _MAX_VIEW / 2).all(axis=1)
    if not near.any():  # all agents are far apart
        near[:] = True
    shown = [agent for agent, is_near in zip(agents, near.tolist(), strict=True) if is_near]
    points = [np.array([(state.x, state.y) for state in agent.states]) for agent in shown]
    # Whole forecasts: a fast vehicle's reaches far beyond the agents
    forecast = [views[agent.id] for agent in shown if agent.id in views]
    points += [_extent(view) for view in forecast if len(view.weights)]
    every = np.concatenate(points)
    low, high = every.min(axis=0) - _MARGIN, every.max(axis=0) + _MARGIN
    missing = np.maximum(_MIN_VIEW - (high - low), 0.0) / 2
    return low - missing, high + missing


def _extent(view: Forecast) -> _Floats:
    """Return the corners of the boxes around the 1-σ ellipses of the shown modes: [·, 2], m."""
    modes = shown_modes(view)
    variances = view.covariances[modes][..., [0, 1], [0, 1]]
    spread = np.sqrt(variances.clip(min=0.0))
    return np.concatenate([view.means[modes] - spread, view.means[modes] + spread]).reshape(-1, 2)


def canvas(size: _Floats) -> tuple[Figure, Axes]:
    """Return an empty figure with the proportions of the view, within limits."""
    inches = np.maximum(LONG_SIDE * size / size.max(), _MIN_SIDE)
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
    """Draw a bar of a round number of metres, about a seventh of the view wide."""
    target = float(high[0] - low[0]) / 7
    length = max(meters for meters in (1, 2, 5, 10, 20, 50, 100) if meters <= max(target, 1.0))
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
        kinds["invalid: no forecast"] = INVALID_COLOR
    squares = [
        Line2D([], [], color=color, label=name, marker="s", linestyle="none", markersize=7)
        for name, color in kinds.items()
    ]
    horizons = ", ".join(f"{seconds:g}" for seconds in ELLIPSE_SECONDS)
    modes = f"modes of weight ≥ {MIN_WEIGHT:g}, at most {MAX_MODES}; fainter is less likely"
    spreads = f"1 σ (filled) and 2 σ at {horizons} s, most likely {MODES_WITH_ELLIPSES} modes"
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
