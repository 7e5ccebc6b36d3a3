"""Right of way among pedestrians whose ways cross: the one who came later lets the other pass."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from cab_forecast.demo.simulation import User

_FORESIGHT = 3.0
"""s."""
_ROOM = 0.9
"""Distance between two who pass each other, m."""
_STAND_BACK = 1.3
"""Distance before the crossing of the ways at which one lets the other pass, m."""
_CROSSING = 0.8
"""Cosine of the angle between two ways from which on they count as parallel."""


def distances_to_wait(users: Sequence["User"]) -> Mapping[int, float]:
    """Return how far pedestrians may go to let others pass, m, by their numbers among the users."""
    numbers = [number for number, user in enumerate(users) if user.kind == "pedestrian"]
    if len(numbers) < 2 or all(users[number].speed == 0 for number in numbers):
        return {}
    walkers = [users[number] for number in numbers]
    position = np.stack([user.position for user in walkers])
    velocity = np.array([user.velocity for user in walkers])
    heading = np.array([user.heading for user in walkers])
    apart = position[None] - position[:, None]  # [N, N, 2], from the one to the other
    relative = velocity[None] - velocity[:, None]
    speed = (relative**2).sum(axis=-1)
    meet = -(apart * relative).sum(axis=-1) / np.maximum(speed, 1e-6)
    closest = np.hypot(*np.moveaxis(apart + meet[..., None] * relative, -1, 0))
    older = np.tri(len(walkers), k=-1, dtype=np.bool_)  # users are in the order in which they came
    crossing = np.abs(np.cos(heading[None] - heading[:, None])) < _CROSSING
    waits = older & crossing & (meet > 0) & (meet < _FORESIGHT) & (closest < _ROOM)
    pace = np.hypot(*velocity.T)
    reach = np.where(waits, pace[:, None] * meet - _STAND_BACK, np.inf).min(axis=1)
    return {numbers[row]: max(float(reach[row]), 0.0) for row in np.flatnonzero(np.isfinite(reach))}
