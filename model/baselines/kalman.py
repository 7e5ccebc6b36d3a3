"""A constant-velocity Kalman filter over the last positions.

State: position and velocity. Between frames the acceleration is white noise (Bar-Shalom, Li, Kirubarajan,
"Estimation with Applications to Tracking and Navigation", 2001, section 6.2.2); positions are measured with
white noise. The axes are independent and alike, so one 2 × 2 covariance of (position, velocity) serves both.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from model.arrays import Bools, Floats, Ints
from model.baselines.unimodal import step_times, unimodal
from model.forecaster import Context, Features, Forecaster, ModelInfo, Protocol
from model.geometry import known_or_zero
from model.mixture import TrajectoryMixture
from model.scenes.scene import STEP_SECONDS, AgentType, Scene

HISTORY_FRAMES = 5
"""Frames that the filter runs over: 2 s, as in the nuScenes prediction challenge."""


@dataclass(frozen=True)
class Noise:
    """The filter's assumptions, for each axis."""

    acceleration_density: float
    """m²/s³, power spectral density of the white acceleration, from ``_MOVING_SPEED`` on."""
    measurement: float
    """m, standard deviation of a measured position."""
    given_velocity: float
    """m/s, standard deviation of the given velocity of an agent with a single observation."""
    standing_density: float | None = None
    """m²/s³, ``acceleration_density`` of an agent below ``_STANDING_SPEED``; None: as of a moving one."""

    def density(self, speed: Floats) -> Floats:
        """Return the power spectral density, linear between standing and moving: [N], m²/s³.

        Args:
            speed: [N], m/s, maximum over the history.
        """
        moving = np.full_like(speed, self.acceleration_density)
        if self.standing_density is None:
            return moving
        share = ((speed - _STANDING_SPEED) / (_MOVING_SPEED - _STANDING_SPEED)).clip(0, 1)
        return self.standing_density + share * (moving - self.standing_density)


_STANDING_SPEED, _MOVING_SPEED = 0.25, 1.0  # m/s

_ANY_SPEED = Noise(acceleration_density=1.087, measurement=0.080, given_velocity=1.0)
_VEHICLE = replace(_ANY_SPEED, standing_density=0.01)
NOISE: Mapping[AgentType, Noise] = {
    AgentType.VEHICLE: _VEHICLE,
    AgentType.PEDESTRIAN: Noise(acceleration_density=0.0268, measurement=0.032, given_velocity=0.3),
    AgentType.CYCLIST: _ANY_SPEED,
    AgentType.UNKNOWN: _ANY_SPEED,
}
"""Noise by agent type. For vehicles and pedestrians, density and measurement noise are fitted to the data
that ``model.baselines.uncertainty`` names, by maximum likelihood of the forecast positions at 0.5, 1, … 6 s.
The noise of given velocities, and all of cyclists and unknown agents, are assumptions.

The density of standing vehicles is the most likely of nine values on those of v1.0-mini: 0.003 up to 0.1 m/s,
0.01 up to 0.3 m/s. With the density of moving vehicles, a parked car's σ would be 8.8 m at 6 s instead of
0.9 m, and all of its true positions would lie in the 90 % ellipses instead of 99 %. Coverage of moving
vehicles: at 3 to 10 m/s, on train_val, 94, 91, 88, 86, 83 and 82 % at 1, 2, … 6 s."""


class Kalman(Forecaster):
    """The filtered position, extrapolated at the filtered velocity: one mode for each agent.

    The covariance is that of the true position, without the noise of measuring it. The first two frames give
    the first state (their difference is the velocity). An agent with a single frame has the velocity given
    with it, or zero.
    """

    info = ModelInfo(
        name="kalman",
        version="1.0.0",
        protocol=Protocol.CAUSAL,
        description="Constant-velocity Kalman filter over the last positions, with its predicted covariance.",
        agent_types=tuple(AgentType),
        context_types=(),
        history_frames=HISTORY_FRAMES,
        modes=1,
        uses_map=False,
        uses_neighbors=False,
        supports_blind=True,
        trained_on="noise only: nuScenes prediction train (vehicles), v1.0-mini (pedestrians)",
        license="Apache-2.0",
    )

    def prepare(self, scene: Scene, targets: Ints, context: Context = Context.FULL) -> Features:
        """Return the positions of the history.

        Returns:
            Float64: ``origin`` [n, 2], the position now; ``positions`` [n, 5, 2] relative to it, oldest
            first, zero before ``first`` [n]; ``velocity`` [n, 2] now.

        Raises:
            ValueError: a target is not observed now.
        """
        states = scene.states.last_frames(HISTORY_FRAMES)
        states.require_observed(targets)
        missing = HISTORY_FRAMES - states.frames
        origin = states.position[targets, -1]
        # Always five frames, even if the scene has fewer, so that agents of many scenes can be joined
        positions = np.zeros((len(targets), HISTORY_FRAMES, 2))
        positions[:, missing:] = known_or_zero(states.position[targets] - origin[:, None])
        return {
            "origin": torch.from_numpy(origin),
            "positions": torch.from_numpy(positions),
            "first": torch.from_numpy(states.first[targets].astype(np.int64) + missing),
            "velocity": torch.from_numpy(known_or_zero(states.velocity[targets, -1])),
        }

    def forecast(
        self,
        features: Features,
        agent_type: AgentType,
        context: Context = Context.FULL,
        steps: int | None = None,
    ) -> TrajectoryMixture:
        """Return one mode for each agent; the context makes no difference.

        Raises:
            ValueError: steps outside 1 … 12.
        """
        noise = NOISE[agent_type]
        time: Floats = step_times(self.info, steps).numpy()
        # In numpy, whose overhead for each of these many small operations is a fraction of torch's
        positions, first, velocity = (features[name].numpy() for name in ("positions", "first", "velocity"))
        density = noise.density(_top_speed(positions, first, velocity))
        state = _filter(positions, first, velocity, noise, density)
        mean = state.position[:, None] + time[:, None] * state.velocity[:, None]
        covariance = np.zeros((*mean.shape, 2))
        covariance[..., 0, 0] = covariance[..., 1, 1] = _predict(state, time, density).var_position
        return unimodal(torch.from_numpy(mean), torch.from_numpy(covariance), features["origin"])


def baselines() -> Sequence[Forecaster]:
    """Return the filter, for the registry."""
    return (Kalman(),)


@dataclass(frozen=True)
class _State:
    """Filtered states of N agents."""

    position: Floats  # [N, 2]
    velocity: Floats  # [N, 2]
    covariance: "_Covariance"


@dataclass(frozen=True)
class _Covariance:
    """Covariances of (position, velocity) along one axis, each [N] or [N, T]."""

    var_position: Floats
    both: Floats
    var_velocity: Floats


def _predict(state: _State, time: Floats, density: Floats) -> _Covariance:
    """Return the covariance at later times [T], s: [N, T].

    It is a sum of positive semi-definite terms, so that it is positive semi-definite, too.
    """
    now = state.covariance
    position, both, velocity = now.var_position[:, None], now.both[:, None], now.var_velocity[:, None]
    density = density[:, None]
    return _Covariance(
        position + 2 * both * time + velocity * time**2 + density * time**3 / 3,
        both + velocity * time + density * time**2 / 2,
        velocity + density * time,
    )


def _top_speed(positions: Floats, first: Ints, velocity: Floats) -> Floats:
    """Return the maximum speed since the first observed frame: [N], m/s.

    So an agent that has just stopped does not count as standing yet.

    Args:
        positions: [N, F, 2], m.
        first: [N], first observed frame.
        velocity: [N, 2], m/s, now.
    """
    moved = positions[:, 1:] - positions[:, :-1]
    between = np.hypot(moved[..., 0], moved[..., 1]) / STEP_SECONDS
    observed = np.arange(between.shape[1]) >= first[:, None]
    top: Floats = np.where(observed, between, 0.0).max(axis=1)
    return np.maximum(top, np.hypot(velocity[:, 0], velocity[:, 1]))


def _filter(positions: Floats, first: Ints, velocity: Floats, noise: Noise, density: Floats) -> _State:
    """Run the filter over the frames, from the first observed one on.

    Args:
        positions: [N, F, 2], m.
        first: [N], first observed frame.
        velocity: [N, 2], m/s, now; used where only the last frame is observed.
        noise: noise of the agents' type.
        density: [N], m²/s³, power spectral density of the acceleration.
    """
    frames = positions.shape[1]
    state = _seen_once(positions[:, -1], velocity, noise)
    for frame in range(1, frames):
        starts, runs = first == frame - 1, first < frame - 1
        started = _seen_twice(positions[:, frame - 1], positions[:, frame], noise, density)
        updated = _update(state, positions[:, frame], noise, density)
        state = _choose(starts, started, _choose(runs, updated, state))
    return state


def _seen_once(position: Floats, velocity: Floats, noise: Noise) -> _State:
    """Return the state of an agent with one position and a given velocity."""
    one = np.ones_like(position[:, 0])
    return _State(
        position, velocity, _Covariance(one * noise.measurement**2, 0 * one, one * noise.given_velocity**2)
    )


def _seen_twice(before: Floats, now: Floats, noise: Noise, density: Floats) -> _State:
    """Return the state from two positions (the filter's limit for an unknown first velocity)."""
    one = np.ones_like(now[:, 0])
    measured = noise.measurement**2
    velocity = 2 * measured / STEP_SECONDS**2 + density * STEP_SECONDS / 3
    return _State(
        now,
        (now - before) / STEP_SECONDS,
        _Covariance(one * measured, one * measured / STEP_SECONDS, one * velocity),
    )


def _update(state: _State, measured: Floats, noise: Noise, density: Floats) -> _State:
    """Advance by one frame: prediction, then correction by the measured position [N, 2]."""
    ahead = _predict(state, np.array([STEP_SECONDS]), density)
    position, both, velocity = ahead.var_position[:, 0], ahead.both[:, 0], ahead.var_velocity[:, 0]
    expected = state.position + STEP_SECONDS * state.velocity
    surprise = measured - expected
    total = position + noise.measurement**2
    gain_position, gain_velocity = position / total, both / total
    return _State(
        expected + gain_position[:, None] * surprise,
        state.velocity + gain_velocity[:, None] * surprise,
        # (I − K H) P, written so that only the last number is a difference
        _Covariance(
            gain_position * noise.measurement**2,
            gain_velocity * noise.measurement**2,
            np.maximum(velocity - gain_velocity * both, 0.0),
        ),
    )


def _choose(mask: Bools, one: _State, other: _State) -> _State:
    """Return one state where the mask [N] is set, else the other."""
    a, b = one.covariance, other.covariance
    return _State(
        np.where(mask[:, None], one.position, other.position),
        np.where(mask[:, None], one.velocity, other.velocity),
        _Covariance(
            np.where(mask, a.var_position, b.var_position),
            np.where(mask, a.both, b.both),
            np.where(mask, a.var_velocity, b.var_velocity),
        ),
    )
