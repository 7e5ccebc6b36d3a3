"""Observations at any rate, brought onto the 0.5 s grid that forecasters work on.

Causal: a grid state depends on what was observed up to the present, never on the future (REFERENCE:
the papers' released preprocessing differentiates centrally over whole tracks; a live service cannot).
What an observation gives is used as it is; what it does not give is derived by backward differences.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.geometry import wrap_angle
from model.observations import Observations
from model.scene import STEP_SECONDS, AgentStates

TIME_TOLERANCE = 1e-4
"""s; an observation this near to a grid time stands for it (3 mm at 30 m/s)."""
MAX_AGE = 0.5
"""s; an agent whose newest observation is older is not observed now."""
MAX_GAP = 1.05
"""s; positions are interpolated between observations no further apart: one lost frame at 2 Hz."""
MIN_DIFFERENCE_SPAN = 0.05
"""s; a shorter span makes a difference quotient of noise."""
MIN_HEADING_SPEED = 0.5
"""m/s; the direction of motion tells the heading from this speed on."""

# Two frames older than those returned: the oldest velocity and acceleration are then differences, too,
# wherever the agent has been seen that long.
_EXTRA_FRAMES = 2


def resample(observations: Observations, time: float, frames: int) -> AgentStates:
    """States on the grid ``time − k · 0.5 s``.

    Positions, and given headings, velocities and so on, are interpolated linearly between observations
    at most ``MAX_GAP`` apart; history before a wider gap is dropped. An agent last seen up to
    ``MAX_AGE`` ago is carried to the present at its velocity. Derivatives that are not given are
    backward differences on the grid; where the oldest frame has no predecessor, its velocity and heading
    rate are those of the next frame and its acceleration is zero. A heading that is not given is the
    direction of motion from ``MIN_HEADING_SPEED`` on, else the last known one.

    Args:
        observations: N agents; none later than ``time`` (+ tolerance).
        time: the present, s.
        frames: F, how many frames to return at most.

    Returns:
        [N, F, …]; ``first`` is F for an agent that is not observed now.
    """
    grid = time - STEP_SECONDS * np.arange(frames + _EXTRA_FRAMES - 1, -1, -1, dtype=np.float64)
    sampled = _sample(observations, grid)
    states = _derive(sampled)
    return states.last_frames(frames)


def velocity_known(observations: Observations, states: AgentStates) -> Bools:
    """[N], whether the velocity now was given or could be derived: not so for a single position."""
    rows = np.arange(len(observations.count))
    last = observations.count - 1
    given = np.isfinite(observations.velocity[rows, last]).all(axis=-1)
    return given | (states.first < states.frames - 1) | (_last_span(observations) >= MIN_DIFFERENCE_SPAN)


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
    rows = np.arange(len(obs.count))[:, None]
    # How many observations lie at or before each grid time: [N, E]
    left = (obs.time[:, :, None] <= grid + TIME_TOLERANCE).sum(axis=1) - 1
    before = left >= 0
    left = np.maximum(left, 0)
    last = obs.count[:, None] - 1
    right = np.minimum(left + 1, last)
    t_left, t_right = obs.time[rows, left], obs.time[rows, right]

    exact = before & (np.abs(t_left - grid) <= TIME_TOLERANCE)
    between = before & ~exact & (right > left) & (t_right - t_left <= MAX_GAP)
    carried = before & ~exact & (left == last) & (grid - t_left <= MAX_AGE + TIME_TOLERANCE)
    carried[:, :-1] = False  # only the present lies after the newest observation of an agent seen now
    there = exact | between | carried

    # The unbroken run that ends now; a gap too wide to interpolate over has a grid time within it.
    run = np.flip(np.logical_and.accumulate(np.flip(there, axis=1), axis=1), axis=1)
    first = grid.size - run.sum(axis=1)

    weight = np.where(between, (grid - t_left) / np.where(between, t_right - t_left, 1.0), 0.0)
    right = np.where(between, right, left)

    def interpolate(values: Floats) -> Floats:
        w = weight.reshape(weight.shape + (1,) * (values.ndim - 2))
        a, b = values[rows, left], values[rows, right]
        result: Floats = a + w * (b - a)
        return result

    a, b = obs.heading[rows, left], obs.heading[rows, right]
    heading = wrap_angle(a + weight * wrap_angle(b - a))  # along the shorter arc
    position = interpolate(obs.position)
    velocity = interpolate(obs.velocity)
    acceleration = interpolate(obs.acceleration)
    heading_rate = interpolate(obs.heading_rate)

    # An agent carried to the present keeps its velocity, given or not, for the way there
    last_velocity = _last_velocity(obs)
    age = np.where(carried[:, -1], grid[-1] - t_left[:, -1], 0.0)
    position[:, -1] += age[:, None] * np.nan_to_num(last_velocity)
    velocity[:, -1] = np.where(carried[:, -1:], last_velocity, velocity[:, -1])

    for values in (position, velocity, acceleration, heading, heading_rate):
        values[~run] = np.nan
    first_velocity = _first_velocity(obs, grid[np.minimum(first, grid.size - 1)])
    return _Sampled(position, velocity, acceleration, heading, heading_rate, first, first_velocity)


def _last_span(obs: Observations) -> Floats:
    """[N], s: from the oldest usable observation (at most 0.5 s before the newest) to the newest."""
    span: Floats = _newest_time(obs) - obs.time[np.arange(len(obs.count)), _last_partner(obs)]
    return span


def _newest_time(obs: Observations) -> Floats:
    newest: Floats = obs.time[np.arange(len(obs.count)), obs.count - 1]
    return newest


def _last_partner(obs: Observations) -> Ints:
    """[N], index of the observation that a difference to the newest one is taken with."""
    newest = _newest_time(obs)[:, None]
    inside = obs.time >= newest - STEP_SECONDS - TIME_TOLERANCE
    oldest_inside = inside.argmax(axis=1)
    # At rates under 2 Hz the previous observation is older than 0.5 s but still connected
    previous = np.maximum(obs.count - 2, 0)
    connected = newest[:, 0] - obs.time[np.arange(len(previous)), previous] <= MAX_GAP
    lone = (oldest_inside == obs.count - 1) & connected
    return np.where(lone, previous, oldest_inside)


def _last_velocity(obs: Observations) -> Floats:
    """[N, 2], m/s at the newest observation: given, else the difference over at most 0.5 s, else NaN."""
    rows = np.arange(len(obs.count))
    last, partner = obs.count - 1, _last_partner(obs)
    span = _last_span(obs)
    usable = span >= MIN_DIFFERENCE_SPAN
    moved = obs.position[rows, last] - obs.position[rows, partner]
    derived = np.where(usable[:, None], moved / np.where(usable, span, 1.0)[:, None], np.nan)
    given = obs.velocity[rows, last]
    return np.where(np.isfinite(given), given, derived)


def _first_velocity(obs: Observations, first_time: Floats) -> Floats:
    """[N, 2], m/s over the observations in the half second up to the first grid frame; NaN where none.

    There is no grid frame before it, so nothing older is connected to it.

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
    usable = span >= MIN_DIFFERENCE_SPAN
    moved = obs.position[rows, newest] - obs.position[rows, oldest]
    return np.where(usable[:, None], moved / np.where(usable, span, 1.0)[:, None], np.nan)


def _derive(s: _Sampled) -> AgentStates:
    """Fills in what was not given."""
    frames = s.position.shape[1]
    observed = np.arange(frames)[None, :] >= s.first[:, None]
    is_first = np.arange(frames)[None, :] == s.first[:, None]

    velocity = s.velocity
    difference = _backward_difference(s.position)
    difference[is_first] = s.first_velocity[s.first < frames]
    velocity = np.where(np.isfinite(velocity), velocity, difference)
    velocity = _fill_first_from_next(velocity, is_first)
    velocity = np.where(np.isfinite(velocity), velocity, 0.0)

    difference = _backward_difference(velocity)
    acceleration = np.where(np.isfinite(s.acceleration), s.acceleration, np.nan_to_num(difference))
    # An unobserved frame before the first one holds the zeros put in above, not a velocity
    unknown = is_first & ~np.isfinite(s.acceleration).all(axis=-1)
    acceleration[unknown] = 0.0

    heading = np.where(np.isfinite(s.heading), s.heading, _direction(velocity))
    heading = _carry(heading, observed)
    turned = np.full_like(heading, np.nan)
    turned[:, 1:] = wrap_angle(heading[:, 1:] - heading[:, :-1]) / STEP_SECONDS
    turned[is_first] = np.nan
    heading_rate = np.where(np.isfinite(s.heading_rate), s.heading_rate, turned)
    heading_rate = np.nan_to_num(_fill_first_from_next(heading_rate, is_first))

    for values in (velocity, acceleration, heading, heading_rate):
        values[~observed] = np.nan
    return AgentStates(s.position, velocity, acceleration, heading, heading_rate, s.first)


def _backward_difference(values: Floats) -> Floats:
    """(values_t − values_{t−1}) / dt along axis 1; NaN at the first."""
    result = np.full_like(values, np.nan)
    result[:, 1:] = (values[:, 1:] - values[:, :-1]) / STEP_SECONDS
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


def _carry(values: Floats, observed: Bools) -> Floats:
    """Fills NaN with the last known value before, else with the first known one after (axis 1)."""
    frames = np.arange(values.shape[1])[None, :]
    known = np.isfinite(values) & observed
    before = np.maximum.accumulate(np.where(known, frames, -1), axis=1)
    after = np.flip(np.minimum.accumulate(np.flip(np.where(known, frames, values.shape[1]), 1), axis=1), 1)
    source = np.where(before >= 0, before, np.minimum(after, values.shape[1] - 1))
    carried: Floats = np.take_along_axis(values, source, axis=1)
    return carried
