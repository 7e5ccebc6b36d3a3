"""The pictures of docs/concepts.md: ``python -m docs.draw_concepts``.

They show forecasts of one vehicle of the demo's junction, whose traffic is always the same. A server must
run; CAB_FORECAST_ENDPOINT names another than that of ``make run``.
"""

import io
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest
from cab_forecast import Client, Forecast, forecasts
from cab_forecast.demo.junction import junction
from cab_forecast.demo.simulation import Simulation
from cab_forecast.demo.ticks import SimulatedTicks
from cab_forecast.plot import (
    GROUND,
    INK,
    TYPE_COLORS,
    draw_agent,
    draw_map,
    draw_modes,
    shown_modes,
)
from docs.generate import DOCS
from model.metrics.consistency import convergence_s, dispersion, errors_by_age_m

_RATE = 10
_NOW = 200
"""Number of the tick that is forecast."""
_AHEAD = 60
"""Ticks of a forecast."""
_AGES = np.arange(0.5, 6.25, 0.5)
_COLORS = 192
_RED = TYPE_COLORS["pedestrian"]
_BLUE = TYPE_COLORS["vehicle"]

_Floats = npt.NDArray[np.float64]


def main() -> None:
    """Draw all pictures."""
    ticks = SimulatedTicks(Simulation(junction(), seed=4), _RATE)
    requests = [ticks.tick(1000 + number / _RATE) for number in range(_NOW + _AHEAD + 1)]
    with Client.from_environment(timeout=10.0) as client:
        now = requests[_NOW]
        now.options.merge, now.options.samples, now.options.seed = True, 80, 1
        agent, forecast = _most_undecided(now, requests[-1], forecasts(client.predict(now)))
        _save("frames", _frames(now, agent, forecast))
        _save("mixture", _mixture(now, agent, forecast))
        instant = requests[-1]
        ages = [requests[-1 - round(age * _RATE)] for age in _AGES]
        made = [forecasts(client.predict(request))[agent.id] for request in ages]
        by_age = np.array([one.most_likely[index] for index, one in enumerate(made)])
        _save("ages", _ages(instant, _of(instant, agent.id), by_age))


def _most_undecided(
    request: PredictRequest, later: PredictRequest, found: dict[str, Forecast]
) -> tuple[Agent, Forecast]:
    """Return the moving vehicle whose likeliest mode is least probable, of those that are there 6 s later."""
    there = {agent.id for agent in later.agents}
    able = [
        agent
        for agent in request.agents
        if agent.id in there
        and len(agent.states) > 20
        and found[agent.id].status == "OK"
        and _speed(agent) > 5
    ]
    chosen = min(able, key=lambda agent: float(found[agent.id].weights.max()))
    return chosen, found[chosen.id]


def _frames(request: PredictRequest, agent: Agent, forecast: Forecast) -> Figure:
    """Draw the ground frame with an agent's axes, and the times of observations and forecast below."""
    figure = _figure(7.6, 6.6)
    ground, times = figure.subplots(2, 1, height_ratios=(4, 1))
    _scene(ground, request, forecast.most_likely, agent)
    states = np.array([(state.time - request.time, state.x, state.y) for state in agent.states])
    grid = states[np.abs(states[:, :1] - np.arange(-2, 0.1, 0.5)).min(axis=1) < 1e-6]
    ground.plot(*states[:, 1:].T, ".", color=INK, markersize=4, zorder=7)
    ground.plot(*grid[:, 1:].T, "o", markerfacecolor="none", color=_RED, markersize=8, zorder=8)
    ground.plot(*forecast.most_likely.T, "o-", color=_BLUE, markersize=4, linewidth=1, zorder=7)
    for seconds in (2, 4, 6):
        _note(ground, forecast.most_likely[2 * seconds - 1], f"+{seconds} s")
    heading, here = agent.states[-1].heading, states[-1, 1:]
    for angle, name in ((heading, "ahead"), (heading + np.pi / 2, "left")):
        tip = here + 9 * np.array([np.cos(angle), np.sin(angle)])
        ground.annotate(
            "", tip, here, arrowprops={"arrowstyle": "-|>", "color": _RED, "linewidth": 1.6}, zorder=9
        )
        _note(ground, tip, name, _RED)
    times.plot(states[:, 0], np.zeros(len(states)), ".", color=INK, markersize=4)
    times.plot(grid[:, 0], np.zeros(len(grid)), "o", markerfacecolor="none", color=_RED, markersize=8)
    times.plot(forecast.times - request.time, np.zeros(len(forecast.times)), "o", color=_BLUE, markersize=4)
    times.axvline(0, color=INK, linewidth=0.8)
    for x, text, color in (
        (-1.0, "observations, any rate", INK),
        (-1.0, "the 2 Hz grid that models see", _RED),
        (3.25, "the forecast: 12 steps of 0.5 s", _BLUE),
    ):
        height = 0.75 if color == INK else -0.75
        times.text(x, height, text, color=color, fontsize=8.5, ha="center", va="center")
    times.set(xlim=(-2.4, 6.4), ylim=(-1.3, 1.3), yticks=[], xticks=np.arange(-2, 6.5))
    times.set_xlabel("seconds from the request's time", fontsize=8.5, color=INK)
    times.spines[["left", "top", "right"]].set_visible(False)
    return figure


def _mixture(request: PredictRequest, agent: Agent, forecast: Forecast) -> Figure:
    """Draw the modes with their weights and ellipses, and beside them samples."""
    figure = _figure(10.4, 5.0)
    modes, samples = figure.subplots(1, 2)
    shown = shown_modes(forecast)
    extent = forecast.means[shown].reshape(-1, 2)
    state = agent.states[-1]
    for axes in (modes, samples):
        _scene(axes, request, extent, agent, margin=4.0)
    draw_modes(modes, forecast, np.array([state.x, state.y]), request.time, _BLUE)
    for mode in shown:
        _note(modes, forecast.means[mode, -1], f"{forecast.weights[mode]:.0%}")
    modes.set_title("modes: weights, means; 1 σ and 2 σ at 2, 4 and 6 s", fontsize=9.5, color=INK)
    here = np.array([[state.x, state.y]])
    for path in forecast.samples:
        samples.plot(*np.concatenate([here, path]).T, color=_BLUE, linewidth=0.7, alpha=0.35, zorder=5)
    samples.plot(*forecast.samples[:, -1].T, ".", color=_BLUE, markersize=4, alpha=0.7, zorder=6)
    samples.set_title(f"{len(forecast.samples)} samples of the same mixture", fontsize=9.5, color=INK)
    return figure


def _ages(request: PredictRequest, agent: Agent, by_age: _Floats) -> Figure:
    """Draw twelve forecasts of one instant, and how far each was from what came.

    Args:
        request: the tick of the instant.
        agent: the agent then.
        by_age: [12, 2], m, the likeliest forecasts of the instant made 0.5 … 6 s before it.
    """
    truth = np.array([agent.states[-1].x, agent.states[-1].y])
    error = errors_by_age_m(by_age[None], truth[None])
    figure = _figure(10.4, 4.6)
    ground, errors = figure.subplots(1, 2, width_ratios=(1, 1.1))
    _scene(ground, request, by_age, agent, margin=6.0)
    ground.scatter(*by_age.T, c=_AGES, cmap="viridis", s=42, edgecolors="white", linewidths=0.6, zorder=8)
    for index in (1, 5, 11):
        _note(ground, by_age[index], f"{_AGES[index]:g} s before")
    ground.plot(*truth, "*", color=_RED, markersize=15, markeredgecolor="white", zorder=9)
    ground.set_title(
        "twelve forecasts of one instant, and where the vehicle was (star)", fontsize=9.5, color=INK
    )
    errors.scatter(-_AGES, error[0], c=_AGES, cmap="viridis", s=42, zorder=5)
    for near in (1.0, 5.0):
        since = float(convergence_s(error, near)[0])
        errors.axhline(near, color=INK, linewidth=0.7, linestyle=(0, (4, 2)))
        errors.text(-6.2, near, f"τ = {near:g} m: C = {since:g} s", fontsize=8.5, color=INK, va="bottom")
    spread = dispersion(by_age[None])
    errors.set_title(
        f"dispersion D: {spread.mean_m[0]:.1f} m (mean), {spread.std_m[0]:.1f} m (std)",
        fontsize=9.5,
        color=INK,
    )
    errors.set(xlim=(-6.4, 0), ylim=(0, None))
    errors.set_xlabel("when the forecast was made, s before the instant", fontsize=8.5, color=INK)
    errors.set_ylabel("error, m", fontsize=8.5, color=INK)
    errors.spines[["top", "right"]].set_visible(False)
    errors.tick_params(labelsize=8, colors=INK)
    return figure


def _scene(axes: Axes, request: PredictRequest, points: _Floats, agent: Agent, margin: float = 14.0) -> None:
    """Draw map and agents around some points and an agent's history."""
    draw_map(axes, request)
    for one in request.agents:
        draw_agent(axes, one, invalid=False, label=False)
    track = np.array([(state.x, state.y) for state in agent.states])
    around = np.concatenate([points, track])
    low, high = around.min(axis=0) - margin, around.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), facecolor=GROUND)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x, m", fontsize=8.5, color=INK)
    axes.set_ylabel("y, m", fontsize=8.5, color=INK)
    axes.tick_params(labelsize=8, colors=INK)


def _note(axes: Axes, at: Sequence[float] | _Floats, text: str, color: str = INK) -> None:
    box = {"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.2}
    place = (float(at[0]), float(at[1]))
    axes.annotate(
        text, place, (6, 6), textcoords="offset points", fontsize=8.5, color=color, bbox=box, zorder=10
    )


def _of(request: PredictRequest, name: str) -> Agent:
    return next(agent for agent in request.agents if agent.id == name)


def _speed(agent: Agent) -> float:
    return float(np.hypot(agent.states[-1].velocity_x, agent.states[-1].velocity_y))


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _save(name: str, figure: Figure) -> None:
    """Write a picture with few colors, and no date or version inside."""
    file = io.BytesIO()
    figure.savefig(file, dpi=100, format="png")
    picture = Image.open(file).convert("RGB").quantize(_COLORS, dither=Image.Dither.NONE)
    picture.save(DOCS / f"images/{name}.png", optimize=True)


if __name__ == "__main__":
    main()
