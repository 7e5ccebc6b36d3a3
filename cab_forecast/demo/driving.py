"""Accelerations of road users, and durations of their ways.

Following is the intelligent driver model (Treiber, Hennecke and Helbing 2000, eq. 2), with a deceleration
that stays comfortable above the desired speed.
"""

import math
from dataclasses import dataclass

import numpy as np

from cab_forecast.demo.lines import STEP, Floats, Line
from cab_forecast.demo.world import Kind

HARDEST_BRAKING = 7.0
"""m/s², what tyres allow on a dry road, rounded down."""
_CLOSE = 0.5
"""Distance to one who drives faster from which on comfortable braking is enough, m."""
_LATERAL = {"vehicle": 2.2, "cyclist": 1.8, "pedestrian": 2.0}
"""Lateral acceleration in curves, m/s²."""


@dataclass(frozen=True)
class Driver:
    """Habits of a road user."""

    speed: float
    """Desired speed on a straight part, m/s."""
    acceleration: float
    """From rest, m/s²."""
    braking: float
    """Comfortable, m/s²."""
    headway: float
    """Time to the one ahead, s."""
    standoff: float
    """Distance to a standing one ahead, m."""


def draw_driver(rng: np.random.Generator, kind: Kind, speed: float) -> Driver:
    """Return a driver whose desired speed is about the given one, m/s."""
    if kind == "vehicle":
        return Driver(
            speed * rng.uniform(0.85, 1.1),
            rng.uniform(1.2, 2.4),
            rng.uniform(1.6, 2.4),
            rng.uniform(0.9, 1.7),
            rng.uniform(1.2, 2.4),
        )
    if kind == "cyclist":
        return Driver(speed * rng.uniform(0.8, 1.2), rng.uniform(0.7, 1.1), 1.8, 1.0, 1.0)
    return Driver(speed * rng.uniform(0.8, 1.2), 1.2, 1.5, 0.3, 0.3)


def speed_limit(line: Line, kind: Kind, braking: float, stops: bool) -> Floats:
    """Return the speed [L], m/s, at the points of a line that lets one take its curves and its end.

    Args:
        line: the line.
        kind: kind of road user.
        braking: deceleration before curves, m/s².
        stops: True if one stops at its end.
    """
    square: Floats = np.minimum(_LATERAL[kind] / np.maximum(np.abs(line.curvature), 1e-4), 60.0**2)
    if stops:
        square[-2:] = 0.0
    # v² ≤ v² there + 2 b · distance, for every place ahead
    slope = 2 * 0.8 * braking * np.arange(len(square)) * STEP
    limit: Floats = np.sqrt(np.maximum(np.minimum.accumulate((square + slope)[::-1])[::-1] - slope, 0.0))
    return limit


def acceleration(driver: Driver, speed: float, limit: float, gap: float, lead_speed: float) -> float:
    """Return the acceleration behind a leader, m/s².

    Args:
        driver: the habits.
        speed: m/s.
        limit: maximum speed at this place, m/s.
        gap: distance from bumper to bumper, m; infinite: nobody is ahead.
        lead_speed: speed of the one ahead, m/s.
    """
    wish = max(min(driver.speed, limit), 0.1)
    if speed <= wish:
        free = driver.acceleration * (1 - (speed / wish) ** 4)
    else:
        free = -min(driver.braking, 2.0 * (speed - wish))
    if math.isinf(gap):
        return free
    closing = speed * (speed - lead_speed) / (2 * math.sqrt(driver.acceleration * driver.braking))
    keep = driver.standoff + max(speed * driver.headway + closing, 0.0)
    wanted = free - driver.acceleration * (keep / max(gap, 0.1)) ** 2
    if lead_speed >= speed and gap > _CLOSE:  # it has cut in, and draws away
        return max(wanted, -driver.braking)
    return max(wanted, -HARDEST_BRAKING)


def duration(distance: float, speed: float, top: float, rate: float) -> float:
    """Return the time that a distance takes, s.

    Args:
        distance: m; at most 0: it takes no time.
        speed: now, m/s.
        top: speed up to which one accelerates, m/s.
        rate: acceleration, m/s².
    """
    if distance <= 0:
        return 0.0
    top = max(top, speed, 0.1)
    reaching = (top**2 - speed**2) / (2 * rate)
    if reaching >= distance:
        return (math.sqrt(speed**2 + 2 * rate * distance) - speed) / rate
    return (top - speed) / rate + (distance - reaching) / top
