"""Observations at any rate, brought onto the 0.5 s grid that forecasters work on.

Causal: a grid state depends on what was observed up to the present, never on the future (REFERENCE:
the papers' released preprocessing differentiates centrally over whole tracks; a live service cannot).
At 2 Hz what an observation gives is used as it is, and what it does not give is derived by backward
differences. Denser observations are evidence, to which the states are fitted (``model.scenes.state_fit``); in
between, from 2.5 to some 4.5 Hz, the one passes over into the other.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.geometry import wrap_angle
from model.scenes.observations import Observations
from model.scenes.scene import STEP_SECONDS, AgentStates
from model.scenes.state_fit import MIN_HEADING_SPEED, FittedStates, fit_states

TIME_TOLERANCE = 1e-4
"""s; an observation this near to a grid time stands for it (3 mm at 30 m/s)."""
MAX_AGE = 0.5
"""s; an agent whose newest observation is older is not observed now."""
MAX_GAP = 1.05
"""s; positions are interpolated between observations no further apart: one lost frame at 2 Hz."""
MIN_DIFFERENCE_SPAN = 0.05
"""s; a shorter span makes a difference quotient of noise."""
FLIP_SPEED = 2.0
"""m/s; from this speed on, motion shows that a single heading is the wrong way round."""

# Two frames older than those returned: the oldest velocity and acceleration are then differences, too,
# wherever the agent has been seen that long.
_EXTRA_FRAMES = 2
_MIN_FLIP_SPAN = 0.15  # s; observations nearer to each other are fitted, and their differences are noise
_ROUNDING = 1e-6  # s; of differences of times since the epoch (a quarter of it at float64), with room


def resample(observations: Observations, time: float, frames: int) -> AgentStates:
    """States on the grid ``time − k · 0.5 s``.

    At 2 Hz positions, and given headings, velocities and so on, are those of the observations at the grid
    times; between observations at most ``MAX_GAP`` apart they are interpolated linearly; history before a
    wider gap is dropped. Derivatives that are not given are backward differences on the grid, of values that
    are both given or both derived; where the oldest frame has no predecessor, its velocity and heading rate
    are those of the next frame and its acceleration is zero. A single given heading that points backwards
    (more than 90° off the motion, at ``FLIP_SPEED`` or more, and off the headings before and after it) is
    replaced by the direction of motion.

    Where observations are denser, position, velocity, acceleration, heading and heading rate are those of a
    fit to the observations within ``model.scenes.state_fit.WINDOW`` before the grid time and,
    up to the present, after it. Given derivatives are measurements like others. So is the course
    over ground, for the heading of what moves; an agent that reverses keeps its headings.

    A heading that is not given is the direction of motion from ``MIN_HEADING_SPEED`` on (the opposite one
    for an agent whose given headings show that it reverses), else the last known one.

    An agent last seen up to ``MAX_AGE`` ago is carried to the present at its velocity then; velocity,
    acceleration, heading and heading rate are those of when it was last seen.

    Args:
        observations: N agents; those later than ``time`` (+ tolerance) are not looked at.
        time: the present, s.
        frames: F, how many frames to return at most.

    Returns:
        [N, F, …]; ``first`` is F for an agent that is not observed now.
    """
    count = frames + _EXTRA_FRAMES
    seen = _upright(_until(observations, time))
    newest = _newest_time(seen)
    age = time - newest
    carried = (age > TIME_TOLERANCE) & (age <= MAX_AGE + TIME_TOLERANCE)
    states = _as_observed(seen, time, count, carried).last_frames(frames)
    times = _grid(np.full(len(newest), time), states.frames)
    times[carried, -1] = newest[carried]
    return _fitted(states, fit_states(seen, times), np.where(carried, age, 0.0))


def history_seconds(frames: int) -> float:
    """How far before the present ``resample`` looks for so many frames, s."""
    return (frames + _EXTRA_FRAMES - 1) * STEP_SECONDS + MAX_AGE + MAX_GAP


def _until(obs: Observations, time: float) -> Observations:
    """The observations up to a time (+ tolerance); the others become padding, but for an only one."""
    later = np.isfinite(obs.time) & (obs.time > time + TIME_TOLERANCE)
    later[:, 0] = False
    if not later.any():
        return obs
    return replace(obs, count=obs.count - later.sum(axis=1), time=np.where(later, np.inf, obs.time))


def _upright(obs: Observations) -> Observations:
    """Turns single headings about that motion and the headings beside them contradict, where observations
    are too far apart to be fitted."""
    with np.errstate(invalid="ignore"):  # the padding's differences
        span = np.diff(obs.time, axis=1)
    connected = (span >= _MIN_FLIP_SPAN) & (span <= MAX_GAP + _ROUNDING)
    before, after = obs.heading[:, :-1], obs.heading[:, 1:]
    if not (connected & np.isfinite(before) & np.isfinite(after)).any():
        return obs
    moved = np.diff(obs.position, axis=1) / np.where(connected, span, np.inf)[..., None]
    fast = np.hypot(moved[..., 0], moved[..., 1]) >= FLIP_SPEED
    direction = np.where(fast, np.arctan2(moved[..., 1], moved[..., 0]), np.nan)
    direction = np.concatenate([direction[:, :1], direction], axis=1)  # the first one's is that to the next
    apart = np.where(connected, np.abs(wrap_angle(after - before)), np.nan)
    none = np.full_like(apart[:, :1], np.nan)
    beside = np.stack([np.concatenate([none, apart], axis=1), np.concatenate([apart, none], axis=1)])
    opposed = (beside > np.pi / 2).any(axis=0) & ~(beside <= np.pi / 2).any(axis=0)
    flipped = opposed & (np.abs(wrap_angle(obs.heading - direction)) > np.pi / 2)
    return replace(obs, heading=np.where(flipped, direction, obs.heading)) if flipped.any() else obs


def _as_observed(obs: Observations, time: float, count: int, carried: Bools) -> AgentStates:
    """States as the observations nearest to the grid times have them.

    Args:
        obs: N agents.
        time: the present, s.
        count: E, frames.
        carried: [N], which agents were last seen a while ago.
    """
    newest = _newest_time(obs)
    sampled = _sample(obs, _grid(np.full(len(newest), time), count))
    if carried.any():
        # How it moved when last seen: the same derivation, on a grid that ends there
        last = _derive(_sample(obs, _grid(newest, count)))
        ahead = last.velocity[carried, -1] * (time - newest[carried])[:, None]
        sampled.position[carried, -1] = last.position[carried, -1] + ahead
    states = _derive(sampled)
    if carried.any():
        for name in ("velocity", "acceleration", "heading", "heading_rate"):
            getattr(states, name)[carried, -1] = getattr(last, name)[carried, -1]
    return replace(states, velocity_known=_last_velocity_known(obs) & (states.first < count))


def _fitted(states: AgentStates, fitted: FittedStates, ahead: Floats) -> AgentStates:
    """Goes from states as observed to fitted ones as far as the fit's share says; without it, not a bit.

    Args:
        states: [N, E].
        fitted: [N, E].
        ahead: [N], s that the last frame's is to be carried on.
    """
    share = np.where(states.observed, fitted.share, 0.0)
    some = share > 0
    if not some.any():
        return states

    def mix(observed: Floats, other: Floats) -> Floats:
        part, mask = (a.reshape(a.shape + (1,) * (observed.ndim - 2)) for a in (share, some))
        return np.where(mask, observed + part * (other - observed), observed)

    position = fitted.position.copy()
    position[:, -1] += fitted.velocity[:, -1] * ahead[:, None]
    # The last known heading is carried from fit to fit; where no fit knows one, it is the observed states'
    course = _reversed_where_given_so(fitted.course, fitted.heading)
    heading = np.where(np.isfinite(fitted.heading), fitted.heading, course)
    heading = _carry(np.where(some, heading, np.nan), states.observed)
    heading = np.where(np.isfinite(heading), heading, states.heading)
    unknown = ~np.isfinite(states.heading)
    turned = wrap_angle(states.heading + share * wrap_angle(heading - states.heading))
    return replace(
        states,
        position=mix(states.position, position),
        velocity=mix(states.velocity, fitted.velocity),
        acceleration=mix(states.acceleration, fitted.acceleration),
        heading=np.where(some, np.where(unknown, heading, turned), states.heading),
        heading_rate=mix(states.heading_rate, fitted.heading_rate),
    )


def _grid(ends: Floats, frames: int) -> Floats:
    """Each agent's grid times [N, frames], which end at ``ends`` [N]."""
    return ends[:, None] - STEP_SECONDS * np.arange(frames - 1, -1, -1, dtype=np.float64)


@dataclass(frozen=True)
class _Sampled:
    """Grid states as observed: NaN where nothing was given. E frames."""

    position: Floats  # [N, E, 2]
    velocity: Floats  # [N, E, 2]
    acceleration: Floats  # [N, E, 2]
    heading: Floats  # [N, E]
    heading_rate: Floats  # [N, E]
    first: Ints  # [N]
    first_velocity: Floats  # [N, 2], from observations between the grid times at the start, or NaN


def _sample(obs: Observations, grid: Floats) -> _Sampled:
    """Interpolates onto grids [N, E]. A last frame after the newest observation is there, without values
    but for a position that stands in until the agent is carried there."""
    rows = np.arange(len(obs.count))[:, None]
    # How many observations lie at or before each grid time: [N, E]
    left = (obs.time[:, :, None] <= grid[:, None, :] + TIME_TOLERANCE).sum(axis=1) - 1
    before = left >= 0
    left = np.maximum(left, 0)
    last = obs.count[:, None] - 1
    right = np.minimum(left + 1, last)
    t_left, t_right = obs.time[rows, left], obs.time[rows, right]

    exact = before & (np.abs(t_left - grid) <= TIME_TOLERANCE)
    between = before & ~exact & (right > left) & (t_right - t_left <= MAX_GAP + _ROUNDING)
    carried = before & ~exact & (left == last) & (grid - t_left <= MAX_AGE + TIME_TOLERANCE)
    carried[:, :-1] = False  # only the present lies after the newest observation of an agent seen now
    there = exact | between | carried

    # The unbroken run that ends now; a gap too wide to interpolate over has a grid time within it.
    run = np.flip(np.logical_and.accumulate(np.flip(there, axis=1), axis=1), axis=1)
    first = grid.shape[1] - run.sum(axis=1)

    weight = np.where(between, (grid - t_left) / np.where(between, t_right - t_left, 1.0), 0.0)
    right = np.where(between, right, left)

    def interpolate(values: Floats) -> Floats:
        w = weight.reshape(weight.shape + (1,) * (values.ndim - 2))
        a, b = values[rows, left], values[rows, right]
        result: Floats = a + w * (b - a)
        result[~run] = np.nan
        return result

    a, b = obs.heading[rows, left], obs.heading[rows, right]
    heading = wrap_angle(a + weight * wrap_angle(b - a))  # along the shorter arc
    heading[~run] = np.nan
    first_time = np.take_along_axis(grid, np.minimum(first, grid.shape[1] - 1)[:, None], axis=1)[:, 0]
    return _Sampled(
        position=interpolate(obs.position),
        velocity=interpolate(obs.velocity),
        acceleration=interpolate(obs.acceleration),
        heading=heading,
        heading_rate=interpolate(obs.heading_rate),
        first=first,
        first_velocity=_first_velocity(obs, first_time),
    )


def _newest_time(obs: Observations) -> Floats:
    newest: Floats = obs.time[np.arange(len(obs.count)), obs.count - 1]
    return newest


def _last_velocity_known(obs: Observations) -> Bools:
    """[N], whether the newest observation gives its velocity, or an earlier one that is connected to it
    (no gap wider than ``MAX_GAP``) is long enough ago for a difference."""
    rows, last = np.arange(len(obs.count)), obs.count - 1
    given = np.isfinite(obs.velocity[rows, last, 0])  # both components, or neither
    with np.errstate(invalid="ignore"):  # the padding's differences
        gap_after = np.diff(obs.time, axis=1, append=np.inf)
    index = np.arange(obs.time.shape[1])[None, :]
    fits = (gap_after <= MAX_GAP + _ROUNDING) | (index >= last[:, None])
    connected = np.flip(np.logical_and.accumulate(np.flip(fits, axis=1), axis=1), axis=1)
    early = obs.time <= _newest_time(obs)[:, None] - MIN_DIFFERENCE_SPAN + _ROUNDING
    known: Bools = given | (connected & early & (index < last[:, None])).any(axis=1)
    return known


def _first_velocity(obs: Observations, first_time: Floats) -> Floats:
    """[N, 2], m/s over the observations in the half second up to the first grid frame; NaN where none.

    There is no grid frame before it, so nothing older is connected to it, unless it is the only one.

    Args:
        first_time: [N], s, when the first grid frame is.
    """
    rows = np.arange(len(obs.count))
    age = first_time[:, None] - obs.time
    usable_time = (age >= -TIME_TOLERANCE) & (age < STEP_SECONDS + TIME_TOLERANCE)
    some = usable_time.any(axis=1)
    oldest = np.where(some, usable_time.argmax(axis=1), 0)
    newest = np.where(some, oldest + usable_time.sum(axis=1) - 1, 0)
    span = obs.time[rows, newest] - obs.time[rows, oldest]
    usable = span >= MIN_DIFFERENCE_SPAN - _ROUNDING
    moved = obs.position[rows, newest] - obs.position[rows, oldest]
    return np.where(usable[:, None], moved / np.where(usable, span, 1.0)[:, None], np.nan)


def _derive(s: _Sampled) -> AgentStates:
    """Fills in what was not given."""
    frames = s.position.shape[1]
    index = np.arange(frames)[None, :]
    observed = index >= s.first[:, None]
    is_first = index == s.first[:, None]

    moved = _backward_difference(s.position)
    moved[is_first] = s.first_velocity[s.first < frames]
    moved = np.nan_to_num(_fill_first_from_next(moved, is_first))
    velocity_given = np.isfinite(s.velocity[..., 0])  # both components are given, or neither
    velocity = np.where(velocity_given[..., None], s.velocity, moved)
    first_given = _fill_first_from_next(s.velocity, is_first)
    velocity = np.where(
        (is_first & ~velocity_given)[..., None] & np.isfinite(first_given), first_given, velocity
    )

    change = _like_with_like(s.velocity, moved, velocity_given)
    change[is_first] = 0.0
    acceleration = np.where(np.isfinite(s.acceleration), s.acceleration, np.nan_to_num(change))

    heading_given = np.isfinite(s.heading)
    direction = _carry(_direction(moved), observed)
    direction = _reversed_where_given_so(direction, s.heading)
    heading = _carry(np.where(heading_given, s.heading, direction), observed)
    turned = _like_with_like(s.heading, direction, heading_given, wrap_angle)
    turned[is_first] = np.nan
    heading_rate = np.where(np.isfinite(s.heading_rate), s.heading_rate, turned)
    heading_rate = np.nan_to_num(_fill_first_from_next(heading_rate, is_first))

    for values in (velocity, acceleration, heading, heading_rate):
        values[~observed] = np.nan
    everyone = np.ones(len(s.first), dtype=np.bool_)
    return AgentStates(s.position, velocity, acceleration, heading, heading_rate, s.first, everyone)


def _backward_difference(values: Floats) -> Floats:
    """(values_t − values_{t−1}) / dt along axis 1; NaN at the first."""
    result = np.full_like(values, np.nan)
    result[:, 1:] = (values[:, 1:] - values[:, :-1]) / STEP_SECONDS
    return result


def _like_with_like(
    given: Floats, derived: Floats, is_given: Bools, difference: Callable[[Floats], Floats] = lambda x: x
) -> Floats:
    """Backward difference quotients of given values, or else of derived ones, never across: a velocity
    given for an instant and one derived over half a second differ even in steady braking.

    Args:
        given: [N, E, …], NaN where not given.
        derived: likewise, everywhere.
        is_given: [N, E].
        difference: brings plain differences into range.
    """
    both = np.zeros_like(is_given)
    both[:, 1:] = is_given[:, 1:] & is_given[:, :-1]
    both = both.reshape(both.shape + (1,) * (given.ndim - 2))
    result = np.full_like(derived, np.nan)
    change = np.where(both[:, 1:], given[:, 1:] - given[:, :-1], derived[:, 1:] - derived[:, :-1])
    result[:, 1:] = difference(change) / STEP_SECONDS
    return result


def _fill_first_from_next(values: Floats, is_first: Bools) -> Floats:
    """Takes the next frame's value where the first observed frame has none."""
    following = np.full_like(values, np.nan)
    following[:, :-1] = values[:, 1:]
    mask = is_first.reshape(is_first.shape + (1,) * (values.ndim - 2))
    return np.where(mask & ~np.isfinite(values), following, values)


def _direction(velocity: Floats) -> Floats:
    """Heading of motion [N, E], NaN below the speed that tells it."""
    moving = np.hypot(velocity[..., 0], velocity[..., 1]) >= MIN_HEADING_SPEED
    return np.where(moving, np.arctan2(velocity[..., 1], velocity[..., 0]), np.nan)


def _reversed_where_given_so(direction: Floats, given: Floats) -> Floats:
    """Directions of motion as headings [N, E]: turned about for agents that go backwards, as their newest
    given heading shows."""
    apart = np.abs(wrap_angle(given - direction))
    known = np.isfinite(apart)
    newest = apart.shape[1] - 1 - np.flip(known, axis=1).argmax(axis=1)
    backwards = known.any(axis=1) & (apart[np.arange(len(apart)), newest] > np.pi / 2)
    return np.where(backwards[:, None], wrap_angle(direction + np.pi), direction)


def _carry(values: Floats, observed: Bools) -> Floats:
    """Fills NaN with the last known value before, else with the first known one after (axis 1)."""
    frames = np.arange(values.shape[1])[None, :]
    known = np.isfinite(values) & observed
    before = np.maximum.accumulate(np.where(known, frames, -1), axis=1)
    after = np.flip(np.minimum.accumulate(np.flip(np.where(known, frames, values.shape[1]), 1), axis=1), 1)
    source = np.where(before >= 0, before, np.minimum(after, values.shape[1] - 1))
    carried: Floats = np.take_along_axis(values, source, axis=1)
    return carried
