"""Right of way where routes cross or merge."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

from cab_forecast.demo.driving import duration
from cab_forecast.demo.world import Zone

if TYPE_CHECKING:
    from cab_forecast.demo.simulation import User

_MARGIN = 1.0
"""Time between two users at a place where their ways cross, s."""
_BEHIND, _BEFORE = 0.4, 1.8
"""The same where the ways go on together, behind the other one and before it, s."""
_TURNING = 4.5
"""Speed up to which one who waits or turns is expected to accelerate at least, m/s."""
_SLUGGISH = 0.6
"""Share of the usual acceleration that one's own way through is reckoned with."""
_STANDS = 2.0
"""Time after which one that stands is not expected to go on at once, s."""
_SHORT_OF = 2.0
"""Distance before the crossing at which it has to stand for that, m."""
_SLOWEST = 1.0
"""Speed at which another one is expected to clear a crossing at least, m/s."""


def may_pass(
    user: "User",
    zones: Sequence[Zone],
    on_route: Mapping[str, Sequence["User"]],
    is_red: Callable[["User"], bool],
) -> bool:
    """Return whether a user's way through zones is free.

    It is not while another one that goes first, or that has begun to pass, is there at about the same time.

    Args:
        user: who wants to pass.
        zones: zones behind the gate.
        on_route: users by the names of their routes.
        is_red: whether a red or yellow light keeps a user from going on.
    """
    return all(_clear(user, zone, foe, is_red(foe)) for zone in zones for foe in on_route.get(zone.foe, ()))


def _clear(user: "User", zone: Zone, foe: "User", foe_waits: bool) -> bool:
    half, foe_half = user.body.length / 2, foe.body.length / 2
    until_gone = zone.foe_end + foe_half - foe.place
    if until_gone < 0:
        return True
    if foe.committed < zone.foe_gate and (not zone.yields or foe_waits):
        return True
    driver = user.driver
    soonest = duration(zone.start - half - user.place, user.speed, driver.speed, driver.acceleration)
    slowly = min(driver.speed, max(user.speed, _TURNING))
    leaves = duration(zone.end + half - user.place, user.speed, slowly, _SLUGGISH * driver.acceleration)
    foe_top = foe.driver.speed
    foe_comes = duration(zone.foe_start - foe_half - foe.place, foe.speed, foe_top, foe.driver.acceleration)
    if foe.waits > _STANDS and zone.foe_start - foe.front > _SHORT_OF:
        return True  # it is held up by something else
    foe_leaves = until_gone / max(foe.speed, _SLOWEST)
    if zone.merges:
        return soonest > foe_leaves + _BEHIND or leaves + _BEFORE < foe_comes
    return soonest > foe_leaves + _MARGIN or leaves + _MARGIN < foe_comes
