"""Simulated traffic: physically possible, on its roads, without collisions, and never at a standstill."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from cab_forecast.demo.driving import HARDEST_BRAKING
from cab_forecast.demo.lines import Floats
from cab_forecast.demo.scenes import SCENES
from cab_forecast.demo.simulation import Simulation, User
from cab_forecast.demo.world import Light, World
from cab_forecast.layers import Layers, decode_layers

SECONDS = 40.0
STEP = 0.1
LATERAL = 4.0
"""Maximum lateral acceleration, m/s²."""


@dataclass(frozen=True)
class Step:
    """The road users after a step."""

    time: float
    users: list[User]
    kinds: np.ndarray[tuple[int], np.dtype[np.str_]]
    corners: Floats
    """[N, 4, 2], m."""
    ahead: Floats
    """[N, 2], unit vectors."""
    states: Floats
    """[N, 4]: speed, acceleration, heading and the time it has stood."""
    routes: list[str]
    events: set[str]


@pytest.fixture(params=SCENES)
def name(request: pytest.FixtureRequest) -> str:
    """Name each scene."""
    scene: str = request.param
    return scene


@cache
def made(name: str) -> World:
    """Make a scene."""
    return SCENES[name]()


@cache
def a_while(name: str) -> list[Step]:
    """Simulate a while of a scene."""
    return list(_steps(Simulation(made(name), seed=5)))


def _steps(simulation: Simulation) -> Iterator[Step]:
    for _ in range(round(SECONDS / STEP)):
        simulation.step(STEP)
        users = simulation.users
        heading = np.array([user.heading for user in users])
        ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
        left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        half = np.array([(user.body.length, user.body.width) for user in users])[:, None] / 2
        signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) * half
        centers = np.stack([user.position for user in users])
        corners = centers[:, None] + signs[..., :1] * ahead[:, None] + signs[..., 1:] * left[:, None]
        states = np.array([(user.speed, user.acceleration, user.heading, user.waits) for user in users])
        yield Step(
            simulation.time,
            list(users),
            np.array([user.kind for user in users]),
            corners,
            ahead,
            states,
            [user.route.name for user in users],
            {_event(user, simulation) for user in users},
        )


def _event(user: User, simulation: Simulation) -> str:
    """Return in words what a user does."""
    gates = user.route.gates
    if user.speed > 1.0:
        return f"{user.kind} on {user.route.name.split('-')[0]}" * bool(np.abs(user.position).max() < 60)
    if user.speed > 0.05:
        return ""
    if not math.isnan(user.parked_until):
        return f"{user.kind} parked"
    if user.gate < len(gates):
        group = gates[user.gate].group
        if group and simulation.world.signals.light(group, simulation.time) is Light.RED:
            return f"{user.kind} waits at red"
        return f"{user.kind} yields" * bool(user.gate)
    return ""


def test_nobody_overlaps(name: str) -> None:
    for step in a_while(name):
        touching = np.ones((len(step.users),) * 2, dtype=np.bool_)
        for axes in (step.ahead, np.stack([-step.ahead[:, 1], step.ahead[:, 0]], axis=-1)):
            places = np.einsum("ni,mki->nmk", axes, step.corners)  # of m's corners along n's axis
            low, high = places.min(axis=-1), places.max(axis=-1)
            apart = (low > np.diag(high)[:, None]) | (high < np.diag(low)[:, None])
            touching &= ~(apart | apart.T)
        pairs = np.argwhere(np.triu(touching, 1))
        assert not len(pairs), f"{step.time:.1f} s: {[[step.users[i].name for i in pair] for pair in pairs]}"


def test_accelerations_are_within_physical_bounds(name: str) -> None:
    headings: dict[str, tuple[float, float]] = {}
    for step in a_while(name):
        speed, acceleration, heading, _ = step.states.T
        assert speed.min() >= 0
        assert acceleration.min() >= -HARDEST_BRAKING - 1e-6
        assert acceleration.max() <= 3.0
        for user, now, v in zip(step.users, heading.tolist(), speed.tolist(), strict=True):
            time, before = headings.get(user.name, (math.nan, now))
            if step.time - time < 1.5 * STEP and user.kind != "pedestrian":
                turned = math.remainder(now - before, 2 * math.pi)
                assert abs(turned) / STEP * v < LATERAL, f"{user.name} at {step.time:.1f} s"
            headings[user.name] = step.time, now


def test_hard_braking_is_rare(name: str) -> None:
    rates = np.concatenate([step.states[:, 1] for step in a_while(name)])
    assert (rates < -4.0).mean() < 0.005


def test_vehicles_and_cyclists_stay_on_the_map(name: str) -> None:
    raster = made(name).raster
    layers: Layers = decode_layers(raster.image, raster.rows, raster.columns)
    for step in a_while(name):
        corners = step.corners[step.kinds != "pedestrian"]
        pixels = np.round((corners - (raster.origin_x, raster.origin_y)) * raster.pixels_per_meter)
        rows, columns = np.moveaxis(pixels.astype(int), -1, 0)
        on_road = layers[0, rows.clip(0, raster.rows - 1), columns.clip(0, raster.columns - 1)]
        assert on_road.all(), f"{step.time:.1f} s: {corners[~on_road.all(axis=1)].mean(axis=1).round(1)}"


def test_users_enter_leave_and_do_not_stand_forever(name: str) -> None:
    world = made(name)
    first, last = ({user.name for user in step.users} for step in (a_while(name)[0], a_while(name)[-1]))
    assert last - first
    assert first - last
    usual = sum(world.population.values())
    assert all(0.5 * usual < len(step.users) <= usual for step in a_while(name))
    for step in a_while(name):
        for route, waits in zip(step.routes, step.states[:, 3].tolist(), strict=True):
            assert waits < 70.0 or world.routes[route].stops


def test_a_seed_repeats_and_another_differs() -> None:
    world = made("roundabout")
    runs = []
    for seed in (1, 1, 2):
        simulation = Simulation(world, seed, users=12)
        for _ in range(30):
            simulation.step(STEP)
        runs.append([(user.name, *user.position.tolist(), user.speed) for user in simulation.users])
    assert runs[0] == runs[1] != runs[2]


def test_everything_happens_at_the_junction() -> None:
    assert {event for step in a_while("junction") for event in step.events} >= {
        "vehicle waits at red",
        "pedestrian waits at red",
        "vehicle yields",
        "vehicle parked",
        "vehicle on leave",
        "vehicle on left",
        "vehicle on right",
        "pedestrian on cross",
        "cyclist on cycle",
    }


def test_vehicles_change_lanes_on_the_motorway() -> None:
    routes: dict[str, set[str]] = {}
    for step in a_while("highway"):
        for user, route in zip(step.users, step.routes, strict=True):
            routes.setdefault(user.name, set()).add(route)
    changed = [taken for taken in routes.values() if len(taken) > 1]
    assert any("entry" in taken for taken in changed)
    assert any({"middle", "left"} <= taken or {"back-middle", "back-left"} <= taken for taken in changed)
