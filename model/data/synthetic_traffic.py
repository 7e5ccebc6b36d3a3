"""Traffic simulation of made-up scenes: vehicles move along given lines.

Following vehicles keep their distance by the intelligent driver model (Treiber, Hennecke and Helbing 2000,
eq. 2).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np

from model.arrays import Bools, Floats
from model.data.synthetic_roads import STEP, headings, places, resample, shifted, smooth

TICK = 0.1
"""s between states of the simulation."""
_HARDEST = 4.5
"""m/s², maximum braking."""
_FASTEST = 40.0
"""m/s, maximum desired speed."""
_JERK = 6.0
"""m/s³."""
_LENGTH = 4.7
"""m, length of a vehicle, bumper to bumper."""
_DISCS = np.array([-1.5, 0.0, 1.5])
"""m ahead of the middle: a vehicle is three discs in a row."""
_CLEARANCE = 1.75
"""m, minimum distance between discs of two vehicles."""


@dataclass(frozen=True)
class Driver:
    """Parameters of a driver."""

    desired: float
    """m/s, on a free straight road."""
    acceleration: float
    """m/s², from rest."""
    braking: float
    """m/s², comfortable."""
    headway: float
    """s."""
    gap: float
    """m to a standing vehicle ahead."""
    lateral: float
    """m/s², maximum lateral acceleration in curves."""


def draw_driver(rng: np.random.Generator, desired: float) -> Driver:
    """Return a driver whose desired speed is about the given one, m/s."""
    return Driver(
        desired=min(desired * rng.uniform(0.85, 1.15), _FASTEST),
        acceleration=rng.uniform(0.8, 3.0),
        braking=rng.uniform(1.0, 3.5),
        headway=rng.uniform(0.8, 2.0),
        gap=rng.uniform(1.5, 3.5),
        lateral=rng.uniform(1.5, 3.0),
    )


_NOBODY = count(-1, -1)


@dataclass
class Vehicle:
    """A vehicle that moves along its line. Times are s from the beginning of the simulation.

    A stream is a queue: a vehicle follows the nearest one ahead in any stream that both are in. Places
    along a stream are m.
    """

    line: Floats
    """[L, 2], m, ``STEP`` apart."""
    place: Floats
    """[L], places of these points along its stream."""
    start: float
    """m along the line."""
    speed: float
    """m/s at the start; lowered where that would be too fast."""
    driver: Driver
    stream: int
    leaves: float = np.inf
    """m along the line at which it leaves the stream."""
    joins: int | None = None
    """The stream that it changes to."""
    joined: float = np.inf
    """m along the line at which it joins that stream."""
    shift: float = 0.0
    """m, from places along its own stream to those along the other."""
    stop: float = np.inf
    """m along the line at which its front bumper waits."""
    until: float = np.inf
    """Time at which the light turns green."""
    wait: float = np.inf
    """s that it stands at the line before it goes on by itself."""
    brakes: tuple[float, float, float] = (np.inf, np.inf, 0.0)
    """Times between which it brakes and then stands, and its braking, m/s²."""
    changes: tuple[float, float] = (np.inf, 1.0)
    """Time at which its desired speed changes, and the factor."""
    backwards: bool = False
    ends: bool = False
    """True if it stops at the end of its line."""
    about_lead: bool = False
    """True if it stands in the lane as an obstacle, or reacts to one that does."""


def wander(rng: np.random.Generator, line: Floats, most: float, *along: Floats) -> tuple[Floats, ...]:
    """Return a driver's own line [L', 2] near a given one, a little aside and wavy, and numbers along it.

    Args:
        rng: random generator.
        line: [L, 2], m, ``STEP`` apart or nearly.
        most: maximum distance from the line, m.
        along: each [L], kept to [L'].
    """
    line, *along_line = resample(line, *along)
    line = smooth(line, rng.uniform(3.0, 5.0))
    place = places(line)
    waves = rng.uniform(0.02, 0.16) * np.sin(place / rng.uniform(8.0, 30.0) + rng.uniform(0, 2 * np.pi))
    d = np.clip(rng.normal(0.0, 0.25) + waves, -most, most)
    return resample(shifted(line, d), *along_line)


@dataclass(frozen=True)
class Drives:
    """N vehicles at T times, ``TICK`` apart."""

    position: Floats
    """[N, T, 2], m."""
    heading: Floats
    """[N, T], rad."""
    speed: Floats
    """[N, T], m/s, never negative."""


@dataclass(frozen=True)
class _Tables:
    """The vehicles' lines side by side, a point each ``STEP``: [N, L], the last values repeated."""

    place: Floats
    """Distance along the line, m."""
    x: Floats
    """m."""
    y: Floats
    """m."""
    heading: Floats
    """rad."""
    limit: Floats
    """m/s, for curves ahead and the end of the line."""

    def at(self, table: Floats, along: Floats) -> Floats:
        """Return values at distances along the lines, m: [N] or [N, T]."""
        index = np.minimum(along / STEP, table.shape[1] - 1.001)
        whole = index.astype(np.int64)
        part = index - whole
        rows = np.arange(len(table)).reshape(-1, *[1] * (along.ndim - 1))
        values: Floats = (1 - part) * table[rows, whole] + part * table[rows, whole + 1]
        return values


def simulate(vehicles: Sequence[Vehicle], seconds: float) -> Drives:
    """Return the motion of vehicles.

    Args:
        vehicles: N ≥ 1 vehicles.
        seconds: duration, s.
    """
    tables = _tables(vehicles)

    def each(name: str) -> Floats:
        return np.array([getattr(one, name) for one in vehicles], dtype=np.float64)

    def driver(name: str) -> Floats:
        return np.array([getattr(one.driver, name) for one in vehicles], dtype=np.float64)

    desired, strongest, braking = driver("desired"), driver("acceleration"), driver("braking")
    headway, standoff = driver("headway"), driver("gap")
    brakes, changes = np.array([one.brakes for one in vehicles]), np.array([one.changes for one in vehicles])
    stop, until, wait = each("stop"), each("until"), each("wait")
    follow = _Following(vehicles)

    along, speed = each("start"), np.minimum(each("speed"), 0.98 * tables.at(tables.limit, each("start")))
    held = stop > along
    for _ in range(2):
        gap, ahead = follow.leads(tables.at(tables.place, along), along, speed)
        gap = np.minimum(gap, np.where(held, stop - along - _LENGTH / 2, np.inf))
        free = np.maximum(gap - standoff - 0.5, 0.0)
        ahead = np.where(np.isfinite(gap), ahead, 0.0)
        speed = np.minimum(speed, np.sqrt(ahead**2 + 1.6 * braking * free))
    acceleration = np.zeros(len(vehicles))
    stood = np.zeros(len(vehicles))
    lines, speeds = [along], [speed]
    for tick in range(1, round(seconds / TICK) + 1):
        now = tick * TICK
        wish = desired * np.where(now >= changes[:, 0], changes[:, 1], 1.0)
        wish = np.maximum(np.minimum(wish, tables.at(tables.limit, along)), 0.05)  # it is a divisor
        gap, ahead = follow.leads(tables.at(tables.place, along), along, speed)
        line = np.where(held, stop - along - _LENGTH / 2, np.inf)
        stood += TICK * (held & (speed < 0.2) & (line < 6.0))
        held &= (now < until) & (stood < wait) & (line > -1.0)
        ahead, gap = np.where(line < gap, 0.0, ahead), np.minimum(gap, line)
        closing = speed * (speed - ahead) / (2 * np.sqrt(strongest * braking))
        keep = standoff + np.maximum(speed * headway + closing, 0.0)
        follows = np.where(np.isfinite(gap), keep / np.maximum(gap, 0.3), 0.0)
        wanted = strongest * (1 - np.minimum(speed / wish, 3.0) ** 4 - follows**2)
        stops = (now >= brakes[:, 0]) & (now < brakes[:, 1])
        wanted = np.where(stops, np.minimum(wanted, -brakes[:, 2]), wanted)
        wanted = np.clip(wanted, -_HARDEST, strongest)
        acceleration += np.clip(wanted - acceleration, -_JERK * TICK, _JERK * TICK)
        new = np.maximum(speed + acceleration * TICK, 0.0)
        along = along + (speed + new) / 2 * TICK
        acceleration = np.where((new == 0.0) & (acceleration < 0), 0.0, acceleration)
        speed = new
        lines.append(along)
        speeds.append(speed)
    turned = np.where(each("backwards") > 0, np.pi, 0.0)
    driven = np.stack(lines, axis=1)
    position = np.stack([tables.at(tables.x, driven), tables.at(tables.y, driven)], axis=-1)
    heading = tables.at(tables.heading, driven) + turned[:, None]
    return Drives(position, heading, np.stack(speeds, axis=1))


def _tables(vehicles: Sequence[Vehicle]) -> _Tables:
    longest = max(len(one.line) for one in vehicles) + 1
    ways = [headings(one.line) for one in vehicles]

    def table(rows: Sequence[Floats]) -> Floats:
        return np.stack([np.concatenate([row, np.full(longest - len(row), row[-1])]) for row in rows])

    heading = table(ways)
    curvature = np.abs(np.gradient(heading, STEP, axis=1))
    lateral = np.array([one.driver.lateral for one in vehicles])[:, None]
    braking = np.array([one.driver.braking for one in vehicles])[:, None]
    square = np.minimum(lateral / np.maximum(curvature, 1e-4), _FASTEST**2)
    for row, one in enumerate(vehicles):
        if one.ends:
            square[row, len(one.line) - 2 :] = 0.0
    # The speed allows braking in time: v² ≤ v² there + 2 b · distance, for every place ahead
    slope = 2 * 0.8 * braking * np.arange(longest) * STEP
    square = np.minimum.accumulate((square + slope)[:, ::-1], axis=1)[:, ::-1] - slope
    return _Tables(
        place=table([one.place for one in vehicles]),
        x=table([one.line[:, 0] for one in vehicles]),
        y=table([one.line[:, 1] for one in vehicles]),
        heading=heading,
        limit=np.sqrt(np.maximum(square, 0.0)),
    )


class _Following:
    """Vehicles that follow each other in streams."""

    def __init__(self, vehicles: Sequence[Vehicle]) -> None:
        own = np.array([one.stream for one in vehicles])
        other = np.array([next(_NOBODY) if one.joins is None else one.joins for one in vehicles])
        self._streams = np.concatenate([own, other])
        self._same = self._streams[:, None] == self._streams[None]
        self._leaves = np.array([one.leaves for one in vehicles])
        self._joined = np.array([one.joined for one in vehicles])
        self._shift = np.array([one.shift for one in vehicles])

    def leads(self, place: Floats, along: Floats, speed: Floats) -> tuple[Floats, Floats]:
        """Return the gap [N], m, to the vehicle ahead (∞: none), and the speed [N], m/s, of that vehicle."""
        there: Bools = np.concatenate([along < self._leaves, along >= self._joined])
        both = np.concatenate([place, place + self._shift])
        apart = both[None] - both[:, None]
        seen = self._same & there[:, None] & there[None] & (apart > 0)
        apart = np.where(seen, apart, np.inf)
        nearest = np.argmin(apart, axis=1)
        rows = np.arange(len(apart))
        gaps = apart[rows, nearest].reshape(2, -1)
        which = np.argmin(gaps, axis=0)
        columns = np.arange(len(speed))
        lead = nearest.reshape(2, -1)[which, columns] % len(speed)
        return gaps[which, columns] - _LENGTH, speed[lead]


def clear(position: Floats, heading: Floats, movers: int) -> Bools:
    """Return which vehicles, [N], remain if those that touch an earlier one are removed.

    Args:
        position: [N, T, 2], m.
        heading: [N, T], rad.
        movers: number of moving vehicles, the first ones. The others all remain, and count as earlier ones.
    """
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    discs = position[..., None, :] + _DISCS[:, None] * ahead[..., None, :]  # [N, T, 3, 2]
    kept = np.ones(len(position), dtype=np.bool_)
    for row in range(movers):
        before = kept.copy()
        before[row:movers] = False
        near = np.hypot(*(position[before] - position[row]).transpose(2, 0, 1)).min(axis=1, initial=np.inf)
        others = discs[before][near < 5.0]
        apart = others[:, :, :, None] - discs[row][:, None]  # [n, T, 3, 3, 2]
        kept[row] = bool((np.einsum("...i,...i", apart, apart) > _CLEARANCE**2).all())
    return kept
