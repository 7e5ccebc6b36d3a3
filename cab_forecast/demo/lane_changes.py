"""Changes of lanes: by the gain in acceleration, where nobody has to brake hard for it.

After MOBIL (Kesting, Treiber and Helbing 2007), without politeness.
"""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cab_forecast.demo.driving import acceleration
from cab_forecast.demo.lines import Floats
from cab_forecast.demo.sight import Leads
from cab_forecast.demo.world import Lanes, Route, World

if TYPE_CHECKING:
    from cab_forecast.demo.simulation import User

_GAIN = 0.35
"""Gain in acceleration that is worth a change to the left, m/s²."""
_TO_THE_RIGHT = -0.1
"""Gain that is enough to go back to the right."""
_SAFE = 2.0
"""Deceleration that a change may cost oneself or the one behind, m/s²."""
_SECONDS = 4.5
"""Duration of a change, s."""
_SHORTEST = 30.0
"""Length of a change at least, m."""
_CONSIDERS, _HAS_TO = 1.5, 0.3
"""Time between two looks at the other lanes, s; and of one whose lane ends."""
_ASIDE = 2.4
"""Distance up to which one counts as on a lane, m."""


def change_lanes(
    users: Sequence["User"], world: World, leads: Leads, rng: np.random.Generator, seconds: float
) -> Iterator[tuple["User", str]]:
    """Yield who begins to change lanes in a step, and the route onto which.

    Args:
        users: road users.
        world: the place.
        leads: who is ahead of whom.
        rng: random generator.
        seconds: duration of the step, s.
    """
    for lanes in world.lanes:
        changing: set[str] = set()
        for index, user in enumerate(users):
            if user.route.name not in lanes.routes or not _is_settled(user):
                continue
            has_to = user.route.name == lanes.ending
            if rng.random() > seconds / (_HAS_TO if has_to else _CONSIDERS):
                continue
            for onto in _beside(user, lanes):
                if onto not in changing and _is_worth_it(user, users, world, leads, index, onto, lanes):
                    changing.add(onto)  # one at a time, so that two do not take the same gap
                    yield user, onto
                    break


def begin_change(user: "User", world: World, onto: str, limit: Floats) -> None:
    """Let a user begin to change onto a route."""
    route = world.routes[onto]
    place, left = route.line.nearest(user.position[None])
    user.route, user.place, user.limit = route, float(place[0]), limit
    user.aside = (float(left[0]), user.place, max(_SECONDS * user.speed, _SHORTEST))


def _is_settled(user: "User") -> bool:
    offset, start, over = user.aside
    return offset == 0.0 or user.place > start + over


def _beside(user: "User", lanes: Lanes) -> Iterator[str]:
    number = lanes.routes.index(user.route.name)
    for other in (number - 1, number + 1):
        if 0 <= other < len(lanes.routes) and lanes.routes[other] != lanes.ending:
            yield lanes.routes[other]


def _is_worth_it(
    user: "User",
    users: Sequence["User"],
    world: World,
    leads: Leads,
    index: int,
    onto: str,
    lanes: Lanes,
) -> bool:
    route = world.routes[onto]
    places, left = route.line.nearest(np.stack([other.position for other in users]))
    if not lanes.start < places[index] < lanes.end:
        return False
    ahead, gap, behind, room = _neighbors(index, users, route, places - places[index], left)
    top = min(user.driver.speed, 60.0)
    after = acceleration(user.driver, user.speed, top, gap, ahead.speed if ahead else 0.0)
    if gap < 2.0 or room < 2.0 or after < -_SAFE:
        return False
    if behind is not None:
        cost = acceleration(behind.driver, behind.speed, behind.driver.speed, room, user.speed)
        if cost < -_SAFE:
            return False
    if user.route.name == lanes.ending:
        return True
    now = acceleration(user.driver, user.speed, top, float(leads.gap[index]), float(leads.speed[index]))
    to_the_right = lanes.routes.index(onto) < lanes.routes.index(user.route.name)
    return after - now > (_TO_THE_RIGHT if to_the_right and after > 0.2 else _GAIN)


def _neighbors(
    index: int, users: Sequence["User"], route: Route, apart: Floats, left: Floats
) -> tuple["User | None", float, "User | None", float]:
    """Return who is ahead on a route, the gap, who is behind, and the gap, m; infinite: nobody.

    Args:
        index: number of the user.
        users: N road users.
        route: the route.
        apart: [N], how far they are ahead along it, m.
        left: [N], how far they are to the left of it, m.
    """
    ahead, gap, behind, room = None, math.inf, None, math.inf
    for number, (away, aside) in enumerate(zip(apart.tolist(), left.tolist(), strict=True)):
        other = users[number]
        if number == index or (abs(aside) > _ASIDE and other.route is not route):
            continue
        free = abs(away) - (users[index].body.length + other.body.length) / 2
        if away >= 0 and free < gap:
            ahead, gap = other, free
        elif away < 0 and free < room:
            behind, room = other, free
    return ahead, gap, behind, room
