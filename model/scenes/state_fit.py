"""States fitted to the observations around a time, where these are denser than 2 Hz.

Around each time, a weighted least-squares fit to the observations within ``WINDOW``: positions, and
velocities and accelerations where given, by a constant acceleration; headings by a constant turn rate.
Weights fall to zero at the window's edge, so that no observation leaves it with a jump. Observations after
the present are not used.

The scatter of the observations about the fit is an estimate of their noise. With more noise, more of the
window counts, the acceleration stays nearer to zero, and the course over ground says less about the heading.

The steps, in the order of this file: ``_share`` tells where observations are dense enough; ``_fit_motion``
fits position, velocity and acceleration by normal equations; ``_fit_heading`` fits heading and heading rate.

The constants minimise the error now over straight, braking, starting, turning, creeping, standing and fast
motion, observed at 5, 10 and 20 Hz with 0 to 10 cm and 0 to 0.1 rad of noise. Longer windows and stiffer
accelerations are better at 10 cm and miss the beginning of braking; shorter ones are the reverse.

Errors now on 30 other, random motions (2 to 30 m/s, accelerations and turns that change every second or so),
as a part of those of single observations and backward differences over 0.5 s: velocity 0.4 without noise, 0.5
to 0.6 at 3 cm, 0.7 (20 Hz), 0.8 (10 Hz) and 1.0 (5 Hz: no gain) at 10 cm; acceleration 0.8 to 0.9; position
0.6 to 0.96 with noise; heading 0.6 to 0.7 at 0.02 rad, 0.3 to 0.4 at 0.1 rad; heading rate 0.3 to 0.5 at 0.1
rad, no gain (0.95 to 1.1) below. Half a second before the present, with observations on both sides, velocity
0.2 to 0.4 and acceleration 0.4. Exact observations lose accuracy: the position is up to 2 cm (RMS) off, the
heading 0.008 rad.

Without noise, arcs of up to 4 m/s² across, with headings, are fitted to 0.2 m/s and 0.02 rad. For a third of
a second after a sudden change of the acceleration by 1 m/s², the velocity is up to 0.15 m/s off.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from model.arrays import Bools, Floats
from model.geometry import wrap_angle
from model.scenes.observations import Observations
from model.scenes.scene import STEP_SECONDS

WINDOW = 1.05
"""s; only observations nearer to a time than this count for it: none before too wide a gap does."""
MIN_HEADING_SPEED = 0.5
"""m/s; from this speed on, the direction of motion determines the heading."""

# The effective window grows with the noise: it is the narrow one without noise, and midway between the narrow
# and the whole one at _HALF_NOISE.
_NARROW_WINDOW = 0.6  # s
_HALF_NOISE = 0.1  # m

# The fit takes over gradually as observations become denser than the grid: by their summed weights, in units
# of those at 2 Hz, and by their standard deviation in time.
_SPARSE, _DENSE = 1.35, 1.75
_SHORT, _LONG = 0.02, 0.07  # s

# Prior of the noise, worth that many observations
_POSITION_NOISE = 0.03  # m
_HEADING_NOISE = 0.05  # rad
_ASSUMED_COUNT = 0.3
# Noise of given derivatives, relative to the noise of positions and headings
_VELOCITY_PER_POSITION = 4.0  # m/s for each m
_ACCELERATION_PER_POSITION = 16.0  # m/s² for each m
_RATE_PER_HEADING = 2.0  # rad/s for each rad

# Priors of acceleration and heading rate: standard deviations about zero
_USUAL_ACCELERATION = 1.7  # m/s²
_USUAL_RATE = 0.4  # rad/s

# The course measures the heading from the first speed on, with full weight from the second
_COURSE_FROM, _COURSE_FULLY = 2.0, 4.0  # m/s
_SLIP = 0.02  # rad, between the course and the heading of an agent that drives straight on
_REAR_AXLE = 1.4  # m behind the middle: there, course and heading agree; in a turn, they differ at the middle
_COURSE_RATE_NOISE = 0.02  # rad/s
# Flipped headings (by half a turn) are outvoted: each heading votes with its weight, and the course with this
# share of their sum. The course breaks ties; from some 6 m/s on, at which nobody reverses, it decides.
_VOTE_AT_REVERSE, _REVERSE_SPEED, _VOTE_PER_SPEED = 0.9, 6.0, 0.6
_OUTLIER_CUTS = (
    1.5,
    0.5,
)  # rad; headings farther from the fit are outliers: first a coarse cut, then a fine one

_MOTION_VARIANCES = 6.0
"""A velocity has a direction if its square exceeds this many of its variances; 95 % of noise does not."""
_FACTORIALS = (1, 1, 2)
_ROUNDING = 1e-9  # keeps divisors above zero


_Scalar = TypeVar("_Scalar", bound=np.generic)


@dataclass(frozen=True)
class FittedStates:
    """Fitted states of N agents at E times. Where the share is 0, the other values are meaningless."""

    share: Floats
    """[N, E], weight of the fit against the states as observed, from 0 (sparse observations) to 1 (dense)."""
    position: Floats
    """[N, E, 2], m."""
    velocity: Floats
    """[N, E, 2], m/s."""
    acceleration: Floats
    """[N, E, 2], m/s²."""
    heading: Floats
    """[N, E], rad; NaN where no observation in the window gives one."""
    heading_rate: Floats
    """[N, E], rad/s."""
    course: Floats
    """[N, E], rad, direction of motion; NaN where the agent is too slow or its motion is within the noise."""


@dataclass(frozen=True)
class _Motion:
    """Fitted motion, and its implications for the heading. All [E, N], except for the first three."""

    position: Floats
    """[2, E, N], m, relative to the agent's origin."""
    velocity: Floats
    """[2, E, N], m/s."""
    acceleration: Floats
    """[2, E, N], m/s²."""
    speed: Floats
    """m/s."""
    course: Floats
    """rad, direction of the velocity."""
    course_known: Bools
    """Mask of velocities that are fast enough, and enough above the noise, to have a direction."""
    course_rate: Floats
    """rad/s."""
    course_variance: Floats
    """rad², variance of the course as a measurement of the heading."""
    rate_variance: Floats
    """rad²/s², variance of the course rate as a measurement of the heading rate."""
    narrowed: Floats
    """Share of the narrow window in the fit, from 0 to 1."""

    @property
    def weight(self) -> Floats:
        """Weight of the course as a measurement of the heading, from 0 to 1."""
        weight: Floats = np.clip((self.speed - _COURSE_FROM) / (_COURSE_FULLY - _COURSE_FROM), 0.0, 1.0)
        return weight


def fit_states(obs: Observations, times: Floats) -> FittedStates:
    """Fit states to observations.

    Args:
        obs: observations of N agents, none after the present.
        times: [N, E], s, times of the states.
    """
    # [S, E, N] throughout: sums over observations then add up in their order, independent of the padding, and
    # agents, the longest axis, are contiguous
    time = _observations_first(obs.time)
    seen = np.isfinite(time)
    after = np.where(seen, time, 0.0) - times.T
    squared = np.where(seen, after**2, np.inf)
    wide = np.maximum(1.0 - squared / WINDOW**2, 0.0)
    total = _sum(wide)
    share = _share(obs, times, total, _sum(wide * after), _sum(wide * np.where(seen, squared, 0.0)))
    if not (share > 0).any():
        return _no_fit(times.shape)
    narrow = np.maximum(1.0 - squared / _NARROW_WINDOW**2, 0.0)

    origin = obs.position[:, 0]
    motion = _fit_motion(obs, origin, wide, narrow, after, share > 0)
    heading = np.full(share.shape, np.nan)
    usual = _USUAL_RATE**2 / (_USUAL_RATE**2 + motion.rate_variance)
    heading_rate = np.where(motion.course_known, motion.course_rate * usual, 0.0)
    weight = wide + motion.narrowed * (narrow - wide)
    given = np.where(_observations_first(np.isfinite(obs.heading)), weight, 0.0)
    some = given.any(axis=0)
    if some.any():
        fitted_heading, fitted_rate = _fit_heading(obs, given, weight, after, motion)
        heading = np.where(some, fitted_heading, heading)
        heading_rate = np.where(some, fitted_rate, heading_rate)
    return FittedStates(
        share.T,
        origin[:, None] + motion.position.T,
        motion.velocity.T,
        motion.acceleration.T,
        heading.T,
        heading_rate.T,
        np.where(motion.course_known, motion.course, np.nan).T,
    )


def _no_fit(shape: tuple[int, ...]) -> FittedStates:
    """Return states of share 0: [N, E]."""
    zero, vectors = np.zeros(shape), np.zeros((*shape, 2))
    unknown = np.full(shape, np.nan)
    return FittedStates(zero, vectors, vectors, vectors, unknown, zero, unknown)


def _observations_first(values: NDArray[_Scalar]) -> NDArray[_Scalar]:
    """Move the observations to the first axis: [N, S] → [S, 1, N]."""
    return np.ascontiguousarray(values.T)[:, None, :]


def _sum(values: Floats) -> Floats:
    """Sum over the observations: [S, …] → […]."""
    total: Floats = np.add.reduce(values, axis=0)
    return total


def _share(obs: Observations, times: Floats, total: Floats, first: Floats, second: Floats) -> Floats:
    """Return the share of the fit, by the density of the observations: [E, N], 0 to 1.

    Args:
        obs: observations of N agents.
        times: [N, E], s, times of the states.
        total: [E, N], summed weights.
        first: [E, N], s, sum of weights · (times of observations − ``times``).
        second: [E, N], s², sum of weights · squares of the same.
    """
    some = np.maximum(total, 1e-9)
    spread = np.sqrt(np.maximum(second / some - (first / some) ** 2, 0.0))
    newest = obs.time[np.arange(len(obs.count)), obs.count - 1]
    steps = np.arange(STEP_SECONDS, WINDOW, STEP_SECONDS)
    neighbors = 1.0 - (steps / WINDOW) ** 2
    there = (
        newest - times.T[..., None, :] > steps[:, None] - STEP_SECONDS / 2
    )  # [E, steps, N]; after the state
    sparse = 1.0 + neighbors.sum() + (neighbors[:, None] * there).sum(axis=-2)
    dense = np.clip((total / sparse - _SPARSE) / (_DENSE - _SPARSE), 0.0, 1.0)
    share: Floats = dense * np.clip((spread - _SHORT) / (_LONG - _SHORT), 0.0, 1.0)
    return share


def _fit_motion(
    obs: Observations, origin: Floats, wide: Floats, narrow: Floats, after: Floats, wanted: Bools
) -> _Motion:
    """Fit a constant acceleration.

    Args:
        obs: observations of N agents.
        origin: [N, 2], m, a point near each agent.
        wide: [S, E, N], weights in the whole window.
        narrow: [S, E, N], weights in the narrow window.
        after: [S, E, N], s, times of the observations relative to the states'.
        wanted: [E, N], states to fit; elsewhere the equations may be singular.
    """
    # Both windows at once, one behind the other along the axis of the states
    equations = _NormalEquations(
        np.concatenate([wide, narrow], axis=1), np.concatenate([after, after], axis=1)
    )
    equations.add(obs.position - origin[:, None], 0, 1.0)
    equations.add(obs.velocity, 1, _VELOCITY_PER_POSITION)
    equations.add(obs.acceleration, 2, _ACCELERATION_PER_POSITION)
    frames = len(wanted)
    information = np.where(wanted, equations.information[:, :, :frames], np.eye(3)[:, :, None, None])
    sides = equations.sides[:, :, :frames]

    # The noise is the scatter about the fit, which has three parameters along each axis
    explained = _Solution(information, sides).explained()
    scatter = np.maximum(equations.squares[:frames] - explained, 0.0)
    rest = np.maximum(2 * equations.count[:frames] - 6, 0.0)
    noise = (scatter + _ASSUMED_COUNT * _POSITION_NOISE**2) / (rest + _ASSUMED_COUNT)

    # The less noise, the more the equations of the narrow window count
    narrowed = _HALF_NOISE**2 / (_HALF_NOISE**2 + noise)
    information = information + narrowed * wanted * (equations.information[:, :, frames:] - information)
    sides = sides + narrowed * (equations.sides[:, :, frames:] - sides)
    solution = _Solution(information, sides)
    position, velocity, acceleration, velocity_variance, acceleration_variance = solution.solve(noise)

    (vx, vy), (ax, ay) = velocity, acceleration
    speed = np.hypot(vx, vy)
    squared = np.maximum(speed**2, 1e-6)
    course_rate = (vx * ay - vy * ax) / squared
    slip = _SLIP + _REAR_AXLE * np.abs(course_rate) / np.sqrt(squared)
    return _Motion(
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        speed=speed,
        course=np.arctan2(vy, vx),
        course_known=(speed >= MIN_HEADING_SPEED) & (squared >= _MOTION_VARIANCES * velocity_variance),
        course_rate=course_rate,
        course_variance=velocity_variance / squared + slip**2,
        rate_variance=acceleration_variance / squared + _COURSE_RATE_NOISE**2,
        narrowed=narrowed,
    )


class _NormalEquations:
    """The normal equations of a constant acceleration along both axes, in W windows.

    The unknowns are position, velocity and acceleration at the window's time.

    Args:
        weight: [S, W, N], weights of the observations.
        after: [S, W, N], s, times of the observations relative to the window's.
    """

    def __init__(self, weight: Floats, after: Floats) -> None:
        self._weight = weight
        self._after = after
        shape = weight.shape[1:]
        self.information = np.zeros((3, 3, *shape))
        """[3, 3, W, N], the matrix of the equations; only its upper triangle is set."""
        self.sides = np.zeros((3, 2, *shape))
        """[3, 2, W, N], the right-hand sides along both axes."""
        self.squares = np.zeros(shape)
        """[W, N], weighted sum of squares of all measurements."""
        self.count = np.zeros(shape)
        """[W, N], summed weights of all measurements."""

    def add(self, values: Floats, order: int, noise: float) -> None:
        """Add measurements of a derivative of the position.

        Args:
            values: [N, S, 2], NaN where not given.
            order: order of the derivative, 0 for positions.
            noise: noise of the measurements, relative to the noise of positions.
        """
        given = np.isfinite(values[..., 0])  # both components, or neither
        if not given.any():
            return
        unknowns = 3 - order
        weights = [self._weight if given.all() else np.where(_observations_first(given), self._weight, 0.0)]
        for _ in range(2 * unknowns - 2):
            weights.append(weights[-1] * self._after)
        moments = [_sum(weight) for weight in weights]
        self.count += moments[0]
        for i in range(unknowns):
            for j in range(i, unknowns):
                moment = moments[i + j] / (_FACTORIALS[i] * _FACTORIALS[j] * noise**2)
                self.information[order + i, order + j] += moment
        columns = [_observations_first(np.where(given, values[..., axis], 0.0)) for axis in (0, 1)]
        for i in range(unknowns):
            for axis, column in enumerate(columns):
                self.sides[order + i, axis] += _sum(weights[i] * column) / (_FACTORIALS[i] * noise**2)
        self.squares += _sum(weights[0] * (columns[0] ** 2 + columns[1] ** 2)) / noise**2


class _Solution:
    """The solution of normal equations, factored as L D Lᵀ.

    Args:
        information: [3, 3, E, N], the matrix, upper triangle.
        sides: [3, 2, E, N], the right-hand sides.
    """

    def __init__(self, information: Floats, sides: Floats) -> None:
        i00, i01, i02 = information[0]
        self._l10, self._l20 = i01 / i00, i02 / i00
        left = information[1, 2] - self._l10 * i02
        self._d0, self._d1 = i00, information[1, 1] - self._l10 * i01
        self._l21 = left / self._d1
        self._d2 = np.maximum(information[2, 2] - self._l20 * i02 - self._l21 * left, 0.0)
        self._first = sides[0]
        self._second = sides[1] - self._l10 * self._first
        self._third = sides[2] - self._l20 * self._first - self._l21 * self._second

    def explained(self) -> Floats:
        """Return the reduction of the sum of squares by the fit, without a prior: [E, N]."""
        last = self._third**2 / (self._d2 + _ROUNDING)
        explained: Floats = (self._first**2 / self._d0 + self._second**2 / self._d1 + last).sum(axis=0)
        return explained

    def solve(self, noise: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Solve for position, velocity and acceleration [2, E, N], with the prior of the acceleration.

        Also return the variances of velocity and acceleration [E, N], which are the same for both axes.

        Args:
            noise: [E, N], m², variance of a position of weight 1.
        """
        d2 = self._d2 + noise / _USUAL_ACCELERATION**2
        acceleration = self._third / d2
        velocity = self._second / self._d1 - self._l21 * acceleration
        position = self._first / self._d0 - self._l10 * velocity - self._l20 * acceleration
        acceleration_variance = noise / d2
        velocity_variance = noise / self._d1 + self._l21**2 * acceleration_variance
        return position, velocity, acceleration, velocity_variance, acceleration_variance


def _fit_heading(
    obs: Observations, given: Floats, weight: Floats, after: Floats, motion: _Motion
) -> tuple[Floats, Floats]:
    """Fit headings of a constant turn rate to the given headings and to the course over ground.

    Args:
        obs: observations of N agents.
        given: [S, E, N], weights of observations with a heading, else 0.
        weight: [S, E, N], weights of all observations.
        after: [S, E, N], s, times of the observations relative to the states'.
        motion: the fitted motion.

    Returns:
        Heading [E, N], rad, and heading rate [E, N], rad/s; meaningless where no heading is given.
    """
    angle = _observations_first(np.nan_to_num(obs.heading))
    # A rough heading by vote, which a single flipped heading does not change
    by_speed = (motion.speed - _COURSE_FROM) / (_REVERSE_SPEED - _COURSE_FROM)
    faster = np.maximum(motion.speed - _REVERSE_SPEED, 0.0)
    vote = _VOTE_AT_REVERSE * np.clip(by_speed, 0.0, 1.0) + _VOTE_PER_SPEED * np.minimum(faster, 1.0)
    vote *= _sum(given)
    near = np.arctan2(
        _sum(given * np.sin(angle)) + vote * np.sin(motion.course),
        _sum(given * np.cos(angle)) + vote * np.cos(motion.course),
    )
    off = angle - near
    off -= 2 * np.pi * np.rint(off / (2 * np.pi))
    course = wrap_angle(motion.course - near)
    course = np.where(np.abs(course) > np.pi / 2, wrap_angle(course + np.pi), course)  # reversing

    # Information beside the headings: the prior of the rate, given rates, the course and its rate
    rate_noise = motion.weight / motion.rate_variance
    rate_information = 1.0 / _USUAL_RATE**2 + rate_noise
    rate_side = rate_noise * motion.course_rate
    rate_given = np.isfinite(obs.heading_rate)
    if rate_given.any():
        rates = (
            np.where(_observations_first(rate_given), weight, 0.0) / (_RATE_PER_HEADING * _HEADING_NOISE) ** 2
        )
        rate_information = rate_information + _sum(rates)
        rate_side = rate_side + _sum(rates * _observations_first(np.nan_to_num(obs.heading_rate)))
    course_information = motion.weight / motion.course_variance

    # Least squares for heading and rate, without outliers; after the coarse pass, the scatter tells the noise
    noise = np.full(near.shape, _HEADING_NOISE**2)
    turned, rate = np.zeros_like(near), np.zeros_like(near)
    for cut in _OUTLIER_CUTS:
        left = off - (turned + rate * after)
        trusted = given * np.maximum(1.0 - (left / cut) ** 2, 0.0) ** 2
        once = trusted * after
        count = _sum(trusted)
        if cut != _OUTLIER_CUTS[0]:
            scatter = _sum(trusted * left**2)
            noise = (scatter + _ASSUMED_COUNT * _HEADING_NOISE**2) / (count + _ASSUMED_COUNT)
        i00 = count / noise + course_information + _ROUNDING
        i01 = _sum(once) / noise
        i11 = _sum(once * after) / noise + rate_information
        side0 = _sum(trusted * off) / noise + course_information * course
        side1 = _sum(once * off) / noise + rate_side
        determinant = i00 * i11 - i01**2
        turned = (i11 * side0 - i01 * side1) / determinant
        rate = (i00 * side1 - i01 * side0) / determinant
    return wrap_angle(near + turned), rate
