"""Who is ahead of whom: road users look along their own lines for the bodies of others."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cab_forecast.demo.lines import Aside, Floats
from cab_forecast.demo.world import World

if TYPE_CHECKING:
    from cab_forecast.demo.simulation import User

_POINTS = 24
"""Number of points at which one looks along a line."""
_SIDE = {"vehicle": 0.25, "cyclist": 0.2, "pedestrian": 0.12}
"""Free space that one keeps beside others, m."""
_REACH = {"vehicle": 14.0, "cyclist": 6.0, "pedestrian": 3.0}
"""Distance that one looks ahead when standing, m."""
_OVERLAP = 0.5
"""Distance by which the stretches between the points overlap, m, so that none is missed in curves."""

_BESIDE, _AROUND = 6.0, 25.0
"""Distances up to which bodies count as beside, m, and up to which those behind count, for ways that turn."""


@dataclass(frozen=True)
class Leads:
    """The nearest body on each user's way."""

    gap: Floats
    """[N], from the front of the one to the other, m; infinite: nobody is there."""
    speed: Floats
    """[N], speed of the other one along the way, m/s; 0 if it comes towards one."""


def look_ahead(users: Sequence["User"], world: World) -> Leads:
    """Return the nearest body on the way of each of N users.

    Args:
        users: N users.
        world: the place with their routes.
    """
    count = len(users)
    if count == 0:
        return Leads(np.zeros(0), np.zeros(0))
    speed = np.array([user.speed for user in users])
    half = np.array([user.body.length / 2 for user in users])
    side = np.array([user.body.width / 2 + _SIDE[user.kind] for user in users])
    braking = np.array([user.driver.braking for user in users])
    reach = np.array([_REACH[user.kind] for user in users]) + 2.5 * speed + speed**2 / (2 * braking)
    apart = reach / _POINTS
    places = np.array([user.place for user in users])[:, None] + np.arange(_POINTS) * apart[:, None]
    points, headings, _ = places_of(users, world, places)  # [N, P, 2], [N, P]
    ahead = np.stack([np.cos(headings), np.sin(headings)], axis=-1)

    owner = np.concatenate([np.full(len(user.body.discs), i) for i, user in enumerate(users)])
    radius = np.array([user.body.radius for user in users])[owner]
    along_body = np.concatenate([user.body.discs for user in users])
    position = np.stack([user.position for user in users])
    heading = np.array([user.heading for user in users])
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    discs = position[owner] + along_body[:, None] * direction[owner]  # [M, 2]

    minded = owner != np.arange(count)[:, None]  # [N, M]
    apart_from = discs - position[:, None]
    distance = np.hypot(apart_from[..., 0], apart_from[..., 1])
    in_front = (apart_from * direction[:, None]).sum(axis=-1) > -_BESIDE
    minded &= (distance < (reach + _BESIDE)[:, None]) & (in_front | (distance < _AROUND))
    who, disc = np.nonzero(minded)  # K pairs of a user and another one's disc
    to_disc = discs[disc][:, None] - points[who]  # [K, P, 2]
    way = ahead[who]
    along = to_disc[..., 0] * way[..., 0] + to_disc[..., 1] * way[..., 1]
    across = np.abs(to_disc[..., 1] * way[..., 0] - to_disc[..., 0] * way[..., 1])
    away = np.arange(_POINTS) * apart[who, None] + along
    blocks = (
        (across < (side[who] + radius[disc])[:, None])
        & (along > -_OVERLAP)
        & (along < (apart[who] + _OVERLAP)[:, None])
        & (away > (half[who] - 0.5)[:, None])
    )
    gaps = np.where(blocks, away - (radius[disc] + half[who])[:, None], np.inf)
    point = gaps.argmin(axis=1)
    gaps = gaps[np.arange(len(gaps)), point]  # [K]

    gap, lead_speed, lead = np.full(count, np.inf), np.zeros(count), np.full(count, -1)
    order = np.lexsort((gaps, who))
    rows, first = np.unique(who[order], return_index=True)
    nearest = order[first]
    found = np.isfinite(gaps[nearest])
    rows, nearest = rows[found], nearest[found]
    gap[rows], lead[rows] = gaps[nearest], owner[disc[nearest]]
    towards = (direction[lead[rows]] * ahead[rows, point[nearest]]).sum(axis=-1)
    lead_speed[rows] = np.maximum(speed[lead[rows]] * towards, 0.0)
    return Leads(gap, lead_speed)


def places_of(users: Sequence["User"], world: World, distances: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the positions, headings and ways of users at distances along their lines, see ``Lines.at``.

    Args:
        users: N users.
        world: the place with their routes.
        distances: [N, F], m.
    """
    numbers = np.array([world.number[user.route.name] for user in users])
    aside = np.array([user.aside for user in users]).reshape(-1, 3)
    return world.lines.at(numbers, distances, Aside(*aside.T))
