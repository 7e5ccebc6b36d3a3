"""Agents, where they were, and where they may be."""

import math

import numpy as np
import numpy.typing as npt
from matplotlib import patheffects
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Ellipse, Polygon

from cab.forecast.v1.prediction_service_pb2 import Agent
from cab_forecast.courses import heading_now
from cab_forecast.forecast import Forecast
from cab_forecast.names import type_name
from cab_forecast.plot_style import INK, NOMINAL_RADIUS, NOMINAL_SIZES, TYPE_COLORS, WRONG

ELLIPSE_SECONDS = (2.0, 4.0, 6.0)
"""Horizons at which positions are marked and spreads drawn."""
SMALLEST_WEIGHT = 0.05
MOST_MODES = 5
MODES_WITH_ELLIPSES = 2

_Floats = npt.NDArray[np.float64]


def color_of(agent: Agent) -> str:
    """By type."""
    return TYPE_COLORS[type_name(agent.type)]


def draw_agent(axes: Axes, agent: Agent, *, wrong: bool, label: bool) -> None:
    """Draws an agent where it is now, oriented as far as its heading is known, and its history.

    Args:
        axes: in the ground frame.
        agent: with at least one state.
        wrong: there is no forecast for it.
        label: write its id beside it.
    """
    color = WRONG if wrong else color_of(agent)
    track = np.array([(state.x, state.y) for state in agent.states])
    now = track[-1]
    axes.plot(*track.T, color=color, linewidth=1.6, alpha=0.55, solid_capstyle="round", zorder=4)
    axes.plot(*track[:-1].T, ".", color=color, markersize=2.5, alpha=0.6, zorder=4)
    size, heading = NOMINAL_SIZES.get(type_name(agent.type)), heading_now(agent)
    outline: Circle | Polygon
    if size is None or heading is None:
        outline = Circle((now[0], now[1]), NOMINAL_RADIUS if size is None else size[1] / 2)
    else:
        outline = Polygon(_pointed_box(now, heading, *size), joinstyle="round")
    outline.set(facecolor=color, edgecolor="white", linewidth=0.9, zorder=6)
    axes.add_patch(outline)
    if wrong:
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
    """Draws the likely modes, the fainter the less likely, with 1- and 2-σ ellipses for the likeliest.

    Args:
        axes: in the ground frame.
        forecast: with K ≥ 1 modes.
        start: [2], the position now, m.
        now: s since the epoch.
        color: of the agent.
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
                _draw_spread(axes, means[step], forecast.covariances[mode, step], color, share)


def shown_modes(forecast: Forecast) -> npt.NDArray[np.int64]:
    """Indices of the modes worth drawing, the likeliest first (and always)."""
    ranked = forecast.ranked_modes[:MOST_MODES]
    likely: npt.NDArray[np.int64] = ranked[forecast.weights[ranked] >= SMALLEST_WEIGHT]
    return likely if len(likely) else ranked[:1]


def marked_steps(forecast: Forecast, now: float) -> list[int]:
    """Indices of the steps at the ellipses' horizons; of a shorter forecast the last one."""
    ahead = forecast.times - now
    steps = [
        int(np.abs(ahead - seconds).argmin()) for seconds in ELLIPSE_SECONDS if seconds <= ahead[-1] + 1e-6
    ]
    return sorted(set(steps)) or [len(ahead) - 1]


def _draw_spread(axes: Axes, mean: _Floats, covariance: _Floats, color: str, share: float) -> None:
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
    """Corners of a box whose front is slightly pointed, so that one sees where it looks: [5, 2]."""
    half = np.array([length, width]) / 2
    corners = np.array([(1.0, 0.0), (0.72, 1.0), (-1.0, 1.0), (-1.0, -1.0), (0.72, -1.0)]) * half
    cos, sin = math.cos(heading), math.sin(heading)
    box: _Floats = center + corners @ np.array([[cos, sin], [-sin, cos]])
    return box
