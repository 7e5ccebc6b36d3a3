"""Scenes for the tests of forecasters."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import Bytes, Float32s, Floats
from model.geometry import rotate, wrap_angle
from model.scenes.scene import AgentStates, AgentType, Scene


def present(
    *,
    position: ArrayLike = (0.0, 0.0),
    velocity: ArrayLike = (0.0, 0.0),
    acceleration: ArrayLike = (0.0, 0.0),
    heading: ArrayLike = np.nan,
    heading_rate: ArrayLike = 0.0,
    kind: AgentType = AgentType.VEHICLE,
) -> Scene:
    """A scene of one agent that is seen only now."""
    states = AgentStates(
        position=_agent(position),
        velocity=_agent(velocity),
        acceleration=_agent(acceleration),
        heading=_agent(heading),
        heading_rate=_agent(heading_rate),
        first=np.zeros(1, dtype=np.int64),
        velocity_known=np.ones(1, dtype=np.bool_),
    )
    return Scene([kind], states)


def tracks(positions: Sequence[ArrayLike], frames: int, kind: AgentType = AgentType.VEHICLE) -> Scene:
    """A scene of agents along positions [n, 2] (n frames up to now, at most ``frames``), velocity by
    differences, the rest zero."""
    count = len(positions)
    position = np.full((count, frames, 2), np.nan)
    velocity = np.full((count, frames, 2), np.nan)
    first = np.zeros(count, dtype=np.int64)
    for n, path in enumerate(positions):
        array = np.asarray(path, dtype=np.float64)
        first[n] = frames - len(array)
        position[n, first[n] :] = array
        velocity[n, first[n] :] = np.diff(array, axis=0, prepend=array[:1]) / 0.5
    zeros = np.where(np.isnan(position), np.nan, 0.0)
    heading = np.full((count, frames), np.nan)
    return Scene(
        [kind] * count,
        AgentStates(position, velocity, zeros, heading, zeros[..., 0], first, first < position.shape[1]),
    )


def crowd(seed: int = 0, frames: int = 5) -> Scene:
    """A scene without raster: four vehicles to be forecast with own map patches (the second one was first
    seen a moment ago, the third reverses, the fourth stands), and around them two pedestrians, a cyclist, a
    vehicle of unknown heading and one that is not observed now."""
    rng = np.random.default_rng(seed)
    vehicle, pedestrian = AgentType.VEHICLE, AgentType.PEDESTRIAN
    kinds = [vehicle] * 4 + [pedestrian] * 2 + [AgentType.CYCLIST] + [vehicle] * 2
    count = len(kinds)
    seconds = 0.5 * np.arange(1 - frames, 1)
    heading = rng.uniform(-np.pi, np.pi, count)[:, None] + rng.normal(0, 0.05, (count, frames))
    speed = rng.uniform(2, 12, count)[:, None] + rng.normal(0, 0.3, (count, frames))
    speed[2], speed[3] = -speed[2], 0.0
    velocity = speed[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    position = rng.uniform(-25, 25, (count, 1, 2)) + seconds[:, None] * velocity
    states = AgentStates(
        position=position,
        velocity=velocity,
        acceleration=rng.normal(0, 1, (count, frames, 2)),
        heading=wrap_angle(heading),
        heading_rate=rng.normal(0, 0.2, (count, frames)),
        first=np.array([0, frames - 2, 0, 0, 0, 0, 0, 0, frames]),
        velocity_known=np.ones(count, dtype=np.bool_),
    )
    states.heading[7] = np.nan
    for name in ("position", "velocity", "acceleration", "heading", "heading_rate"):
        getattr(states, name)[~states.observed] = np.nan
    near, far = (
        dict[int, Bytes | Float32s](
            {n: rng.integers(0, 2, (3, 25, 25), dtype=np.uint8).repeat(4, 1).repeat(4, 2) for n in range(4)}
        )
        for _ in range(2)
    )
    return Scene(kinds, states, None, near, far)


def moved(scene: Scene, angle: float, shift: ArrayLike) -> Scene:
    """The scene turned about the ground frame's origin, then shifted; it has no raster."""
    states = scene.states
    turn = np.array(angle)
    return replace(
        scene,
        states=replace(
            states,
            position=rotate(states.position, turn) + np.asarray(shift),
            velocity=rotate(states.velocity, turn),
            acceleration=rotate(states.acceleration, turn),
            heading=wrap_angle(states.heading + turn),
        ),
    )


def _agent(values: ArrayLike) -> Floats:
    """[1, 1, ...]"""
    return np.asarray(values, dtype=np.float64)[None, None]
