"""Resampling of observations at any rate onto the 0.5 s grid of the forecasters.

Resampling is causal: a grid state depends on observations up to the present, never on the future (REFERENCE:
the papers' released preprocessing differentiates centrally over whole tracks, which a live service cannot
do). At 2 Hz, given values are used as they are, and missing ones are derived by backward differences. Denser
observations are evidence, to which states are fitted (``model.scenes.state_fit``). From 2.5 to about 4.5 Hz,
the first method passes over into the second.

The steps, in the order of this file: drop later observations, correct flipped headings, interpolate onto the
grid, derive missing values, extrapolate agents last seen a moment ago, and blend with the fitted states.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.geometry import known_or_zero, wrap_angle
from model.scenes.observations import Observations
from model.scenes.scene import STEP_SECONDS, AgentStates
from model.scenes.state_fit import MIN_HEADING_SPEED, FittedStates, fit_states

TIME_TOLERANCE = 1e-4
"""s; an observation this near to a grid time counts as at that time (3 mm at 30 m/s)."""
MAX_AGE = 0.5
"""s, maximum age of the newest observation of an agent that is observed now."""
MAX_GAP = 1.05
"""s, maximum gap to interpolate over: one lost frame at 2 Hz."""
MIN_DIFFERENCE_SPAN = 0.05
"""s, minimum span of a difference quotient; over a shorter one it would be noise."""
FLIP_SPEED = 2.0
"""m/s; from this speed on, motion shows that a single heading is flipped by half a turn."""

# Two frames older than the returned ones, so that the oldest velocity and acceleration are differences, too,
# if the agent has been observed that long.
_EXTRA_FRAMES = 2
_MIN_FLIP_SPAN = 0.15  # s; observations nearer to each other are fitted; their differences are noise
_ROUNDING = 1e-6  # s; exceeds the rounding of float64 differences of times since the epoch four times


def resample(observations: Observations, time: float, frames: int) -> AgentStates:
    """Resample observations onto the grid ``time − k · 0.5 s``.

    At 2 Hz, positions and given headings, velocities and so on are those of the observations at the grid
    times. Between observations at most ``MAX_GAP`` apart they are interpolated linearly; history before a
    wider gap is dropped. Derivatives that are not given are backward differences on the grid, of values that
    are both given or both derived. The oldest frame has no predecessor: its velocity and heading rate are
    those of the next frame, and its acceleration is zero. A single given heading that points backwards (more
    than 90° off the motion, at ``FLIP_SPEED`` or more, and off the headings before and after it) is replaced
    by the direction of motion.

    Where observations are denser, position, velocity, acceleration, heading and heading rate are those of a
    fit to the observations within ``model.scenes.state_fit.WINDOW`` before the grid time and, up to the
    present, after it. Given derivatives are measurements for this fit. The course over ground is one of the
    heading, if the agent moves; an agent that reverses keeps its headings.

    A heading that is not given is the direction of motion from ``MIN_HEADING_SPEED`` on (the opposite
    direction if given headings show that the agent reverses), else the last known heading.

    An agent last seen up to ``MAX_AGE`` ago is extrapolated to the present at its last velocity; velocity,
    acceleration, heading and heading rate stay those of its last observation.

    Args:
        observations: N agents; observations later than ``time`` (+ tolerance) are ignored.
        time: the present, s.
        frames: F, maximum number of frames to return.

    Returns:
        [N, F, …]; ``first`` is F for an agent that is not observed now.
    """
    count = frames + _EXTRA_FRAMES
    seen = _correct_flipped_headings(_without_future(observations, time))
    newest = _newest_time(seen)
    age = time - newest
    extrapolated = (age > TIME_TOLERANCE) & (age <= MAX_AGE + TIME_TOLERANCE)
    states = _observed_states(seen, time, count, extrapolated).last_frames(frames)
    times = _grid(np.full(len(newest), time), states.frames)
    times[extrapolated, -1] = newest[extrapolated]
    return _blend(states, fit_states(seen, times), np.where(extrapolated, age, 0.0))


def history_seconds(frames: int) -> float:
    """Return the age, s, up to which ``resample`` uses observations for that many frames."""
    return (frames + _EXTRA_FRAMES - 1) * STEP_SECONDS + MAX_AGE + MAX_GAP


def _without_future(obs: Observations, time: float) -> Observations:
    """Turn observations after a time (+ tolerance) into padding, except the first one of an agent."""
    later = np.isfinite(obs.time) & (obs.time > time + TIME_TOLERANCE)
    later[:, 0] = False
    if not later.any():
        return obs
    return replace(obs, count=obs.count - later.sum(axis=1), time=np.where(later, np.inf, obs.time))


def _correct_flipped_headings(obs: Observations) -> Observations:
    """Replace single headings that contradict both the motion and the headings before and after them.

    Only where observations are too far apart to be fitted; the fit deals with outliers by itself.
    """
    with np.errstate(invalid="ignore"):  # the padding's differences
        span = np.diff(obs.time, axis=1)
    connected = (span >= _MIN_FLIP_SPAN) & (span <= MAX_GAP + _ROUNDING)
    before, after = obs.heading[:, :-1], obs.heading[:, 1:]
    if not (connected & np.isfinite(before) & np.isfinite(after)).any():
        return obs
    moved = np.diff(obs.position, axis=1) / np.where(connected, span, np.inf)[..., None]
    fast = np.hypot(moved[..., 0], moved[..., 1]) >= FLIP_SPEED
    direction = np.where(fast, np.arctan2(moved[..., 1], moved[..., 0]), np.nan)
    direction = np.concatenate(
        [direction[:, :1], direction], axis=1
    )  # the first observation has the direction to the next
    apart = np.where(connected, np.abs(wrap_angle(after - before)), np.nan)
    none = np.full_like(apart[:, :1], np.nan)
    beside = np.stack([np.concatenate([none, apart], axis=1), np.concatenate([apart, none], axis=1)])
    opposed = (beside > np.pi / 2).any(axis=0) & ~(beside <= np.pi / 2).any(axis=0)
    flipped = opposed & (np.abs(wrap_angle(obs.heading - direction)) > np.pi / 2)
    return replace(obs, heading=np.where(flipped, direction, obs.heading)) if flipped.any() else obs


def _observed_states(obs: Observations, time: float, count: int, extrapolated: Bools) -> AgentStates:
    """Return grid states by interpolation and backward differences, without a fit.

    Args:
        obs: observations of N agents.
        time: the present, s.
        count: E, frames.
        extrapolated: [N], agents whose newest observation is older than the present.
    """
    newest = _newest_time(obs)
    sampled = _interpolate(obs, _grid(np.full(len(newest), time), count))
    if extrapolated.any():
        # Its motion when last seen: the same derivation, on a grid that ends there
        last = _derive(_interpolate(obs, _grid(newest, count)))
        ahead = last.velocity[extrapolated, -1] * (time - newest[extrapolated])[:, None]
        sampled.position[extrapolated, -1] = last.position[extrapolated, -1] + ahead
    states = _derive(sampled)
    if extrapolated.any():
        for name in ("velocity", "acceleration", "heading", "heading_rate"):
            getattr(states, name)[extrapolated, -1] = getattr(last, name)[extrapolated, -1]
    return replace(states, velocity_known=_last_velocity_known(obs) & (states.first < count))


def _grid(ends: Floats, frames: int) -> Floats:
    """Return each agent's grid times [N, frames], which end at ``ends`` [N]."""
    return ends[:, None] - STEP_SECONDS * np.arange(frames - 1, -1, -1, dtype=np.float64)


@dataclass(frozen=True)
class _GridSamples:
    """Observations at E grid times; NaN where nothing was given."""

    position: Floats  # [N, E, 2]
    velocity: Floats  # [N, E, 2]
    acceleration: Floats  # [N, E, 2]
    heading: Floats  # [N, E]
    heading_rate: Floats  # [N, E]
    first: Ints  # [N]
    first_velocity: Floats  # [N, 2], from the observations just before the first grid frame, or NaN


def _interpolate(obs: Observations, grid: Floats) -> _GridSamples:
    """Interpolate observations onto grids [N, E].

    A last frame after the newest observation has no values, except for a position that is a placeholder until
    the agent is extrapolated.
    """
    rows = np.arange(len(obs.count))[:, None]
    # Index of the last observation at or before each grid time: [N, E]
    left = (obs.time[:, :, None] <= grid[:, None, :] + TIME_TOLERANCE).sum(axis=1) - 1
    before = left >= 0
    left = np.maximum(left, 0)
    last = obs.count[:, None] - 1
    right = np.minimum(left + 1, last)
    t_left, t_right = obs.time[rows, left], obs.time[rows, right]

    exact = before & (np.abs(t_left - grid) <= TIME_TOLERANCE)
    between = before & ~exact & (right > left) & (t_right - t_left <= MAX_GAP + _ROUNDING)
    extrapolated = before & ~exact & (left == last) & (grid - t_left <= MAX_AGE + TIME_TOLERANCE)
    extrapolated[:, :-1] = (
        False  # of an agent observed now, only the present frame lies after the newest observation
    )
    there = exact | between | extrapolated

    # The unbroken run that ends now; any gap too wide to interpolate over contains a grid time
    run = np.logical_and.accumulate(there[:, ::-1], axis=1)[:, ::-1]
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
    first_time = grid[rows[:, 0], np.minimum(first, grid.shape[1] - 1)]
    return _GridSamples(
        position=interpolate(obs.position),
        velocity=interpolate(obs.velocity),
        acceleration=interpolate(obs.acceleration),
        heading=heading,
        heading_rate=interpolate(obs.heading_rate),
        first=first,
        first_velocity=_first_velocity(obs, first_time),
    )


def _first_velocity(obs: Observations, first_time: Floats) -> Floats:
    """Return the velocity over the observations in the half second before the first grid frame.

    Older observations do not count: with no grid frame before the first one, they are not connected to it
    (unless it is the only one).

    Args:
        obs: observations of N agents.
        first_time: [N], s, time of the first grid frame.

    Returns:
        [N, 2], m/s; NaN where there are too few observations.
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


def _derive(s: _GridSamples) -> AgentStates:
    """Derive missing values, and return complete states."""
    frames = s.position.shape[1]
    index = np.arange(frames)[None, :]
    observed = index >= s.first[:, None]
    is_first = index == s.first[:, None]

    moved = _backward_difference(s.position)
    moved[is_first] = s.first_velocity[s.first < frames]
    moved = known_or_zero(_fill_first_from_next(moved, is_first))
    velocity_given = np.isfinite(s.velocity[..., 0])  # both components are given, or neither
    velocity = np.where(velocity_given[..., None], s.velocity, moved)
    first_given = _fill_first_from_next(s.velocity, is_first)
    velocity = np.where(
        (is_first & ~velocity_given)[..., None] & np.isfinite(first_given), first_given, velocity
    )

    change = _consistent_difference(s.velocity, moved, velocity_given)
    change[is_first] = 0.0
    acceleration = np.where(np.isfinite(s.acceleration), s.acceleration, known_or_zero(change))

    heading_given = np.isfinite(s.heading)
    direction = _fill_unknown(_direction(moved), observed)
    direction = _reverse_if_backing(direction, s.heading)
    heading = _fill_unknown(np.where(heading_given, s.heading, direction), observed)
    turned = _consistent_difference(s.heading, direction, heading_given, wrap_angle)
    turned[is_first] = np.nan
    heading_rate = np.where(np.isfinite(s.heading_rate), s.heading_rate, turned)
    heading_rate = known_or_zero(_fill_first_from_next(heading_rate, is_first))

    for values in (velocity, acceleration, heading, heading_rate):
        values[~observed] = np.nan
    everyone = np.ones(len(s.first), dtype=np.bool_)
    return AgentStates(s.position, velocity, acceleration, heading, heading_rate, s.first, everyone)


def _backward_difference(values: Floats) -> Floats:
    """Return (values_t − values_{t−1}) / dt along axis 1; NaN in the first frame."""
    result = np.full_like(values, np.nan)
    result[:, 1:] = (values[:, 1:] - values[:, :-1]) / STEP_SECONDS
    return result


def _consistent_difference(
    given: Floats, derived: Floats, is_given: Bools, difference: Callable[[Floats], Floats] = lambda x: x
) -> Floats:
    """Return backward difference quotients of two given values, or else of two derived ones.

    They are never of a given and a derived value: a velocity given for an instant and one derived over half a
    second differ even in steady braking.

    Args:
        given: [N, E, …], NaN where not given.
        derived: [N, E, …], known in all frames.
        is_given: [N, E], whether values are given.
        difference: function that wraps plain differences into range.
    """
    both = np.zeros_like(is_given)
    both[:, 1:] = is_given[:, 1:] & is_given[:, :-1]
    both = both.reshape(both.shape + (1,) * (given.ndim - 2))
    result = np.full_like(derived, np.nan)
    change = np.where(both[:, 1:], given[:, 1:] - given[:, :-1], derived[:, 1:] - derived[:, :-1])
    result[:, 1:] = difference(change) / STEP_SECONDS
    return result


def _fill_first_from_next(values: Floats, is_first: Bools) -> Floats:
    """Fill a missing value of the first observed frame with that of the next frame."""
    following = np.full_like(values, np.nan)
    following[:, :-1] = values[:, 1:]
    mask = is_first.reshape(is_first.shape + (1,) * (values.ndim - 2))
    return np.where(mask & ~np.isfinite(values), following, values)


def _direction(velocity: Floats) -> Floats:
    """Return the direction of motion: [N, E]; NaN below ``MIN_HEADING_SPEED``."""
    moving = np.hypot(velocity[..., 0], velocity[..., 1]) >= MIN_HEADING_SPEED
    return np.where(moving, np.arctan2(velocity[..., 1], velocity[..., 0]), np.nan)


def _last_velocity_known(obs: Observations) -> Bools:
    """Return whether the velocity of the newest observation is known: [N].

    It is if it was given, or if an earlier observation is old enough for a difference quotient and connected
    to the newest one (without a gap wider than ``MAX_GAP``).
    """
    rows, last = np.arange(len(obs.count)), obs.count - 1
    given = np.isfinite(obs.velocity[rows, last, 0])  # both components, or neither
    with np.errstate(invalid="ignore"):  # the padding's differences
        gap_after = np.diff(obs.time, axis=1, append=np.inf)
    index = np.arange(obs.time.shape[1])[None, :]
    fits = (gap_after <= MAX_GAP + _ROUNDING) | (index >= last[:, None])
    connected = np.logical_and.accumulate(fits[:, ::-1], axis=1)[:, ::-1]
    early = obs.time <= _newest_time(obs)[:, None] - MIN_DIFFERENCE_SPAN + _ROUNDING
    known: Bools = given | (connected & early & (index < last[:, None])).any(axis=1)
    return known


def _newest_time(obs: Observations) -> Floats:
    """Return the time of each agent's newest observation: [N], s."""
    newest: Floats = obs.time[np.arange(len(obs.count)), obs.count - 1]
    return newest


def _blend(states: AgentStates, fitted: FittedStates, ahead: Floats) -> AgentStates:
    """Blend observed with fitted states, by the share of the fit; states of share 0 stay bit-equal.

    Args:
        states: [N, E], observed states.
        fitted: [N, E], fitted states.
        ahead: [N], s, by which the last fitted frame is extrapolated.
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
    # An unknown heading is the last one of a fit; if no fit has one, the observed states' heading
    course = _reverse_if_backing(fitted.course, fitted.heading)
    heading = np.where(np.isfinite(fitted.heading), fitted.heading, course)
    heading = _fill_unknown(np.where(some, heading, np.nan), states.observed)
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


def _reverse_if_backing(direction: Floats, given: Floats) -> Floats:
    """Return headings from directions of motion: [N, E].

    They are the opposite of the direction if the agent reverses, as its newest given heading shows.
    """
    apart = np.abs(wrap_angle(given - direction))
    known = np.isfinite(apart)
    newest = apart.shape[1] - 1 - known[:, ::-1].argmax(axis=1)
    backwards = known.any(axis=1) & (apart[np.arange(len(apart)), newest] > np.pi / 2)
    return np.where(backwards[:, None], wrap_angle(direction + np.pi), direction)


def _fill_unknown(values: Floats, observed: Bools) -> Floats:
    """Fill NaN with the last known value before it, else with the first known one after it (axis 1)."""
    frames = np.arange(values.shape[1])[None, :]
    known = np.isfinite(values) & observed
    before = np.maximum.accumulate(np.where(known, frames, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, frames, values.shape[1])[:, ::-1], axis=1)[:, ::-1]
    source = np.where(before >= 0, before, np.minimum(after, values.shape[1] - 1))
    filled: Floats = values[np.arange(len(values))[:, None], source]
    return filled
