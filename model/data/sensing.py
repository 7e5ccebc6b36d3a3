"""Simulated tracker reports of recorded tracks, as inputs for training.

Recorded scenes have clean poses at 2 Hz. A service gets observations at any rate, with noise, with and
without headings and velocities, with gaps, of agents first seen a moment ago. Such observations are drawn
here from recorded tracks and resampled onto the grid by ``model.scenes.resample``, as the server does.

Between recorded poses an agent moves along a cubic Hermite spline. Its tangent now comes from the past alone
(a parabola through the last three poses): a tangent from both sides would leak the next position into the
observations, as it does in the papers' inputs.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.data.protocols import SceneFrames
from model.data.scenes import SceneRecord
from model.forecaster import Protocol
from model.geometry import wrap_angle
from model.scenes.observations import Observations
from model.scenes.resample import resample
from model.scenes.scene import STEP_SECONDS, AgentStates, Scene

RATES_HZ = (2.0, 4.0, 5.0, 10.0, 20.0)
_RATE_SHARES = (0.3, 0.1, 0.1, 0.35, 0.15)
MAX_POSITION_NOISE_M = 0.1
MAX_HEADING_NOISE_RAD = 0.1
MAX_VELOCITY_NOISE_MPS = 0.3
MAX_JITTER_S = 0.03
_SPAN_S = 3.5
"""s of observations up to the present, enough for the history and its derivatives."""


@dataclass(frozen=True)
class _Draw:
    """Parameters of the report of one scene at one frame."""

    rate_hz: float
    position_noise_m: float
    heading_noise_rad: float
    velocity_noise_mps: float
    jitter_s: float
    lost_share: float

    @classmethod
    def of(cls, random: np.random.Generator) -> "_Draw":
        def sometimes(share: float, maximum: float) -> float:
            return maximum * random.random() if random.random() < share else 0.0

        return cls(
            rate_hz=float(random.choice(RATES_HZ, p=_RATE_SHARES)),
            position_noise_m=sometimes(0.8, MAX_POSITION_NOISE_M),
            heading_noise_rad=sometimes(0.8, MAX_HEADING_NOISE_RAD),
            velocity_noise_mps=sometimes(0.7, MAX_VELOCITY_NOISE_MPS),
            jitter_s=sometimes(0.3, MAX_JITTER_S),
            lost_share=sometimes(0.2, 0.4),
        )


class SensedFrames:
    """The frames of one recorded scene, as a tracker might have reported them.

    Args:
        record: the recorded scene.
        history_frames: F, frames of history, now included.
        seed: seed of all that is random.
    """

    def __init__(self, record: SceneRecord, history_frames: int, seed: int) -> None:
        self._record = record
        self._history_frames = history_frames
        self._seed = seed
        self._frames = SceneFrames(record, Protocol.CAUSAL, history_frames)

    def at(self, frame: int, variant: int) -> tuple[Scene, Ints]:
        """Return one report of the scene at a frame, and the index of each agent's track [N].

        The agents are those of ``SceneFrames.at``. An agent whose report has no heading or no velocity (it
        stands and reports no heading, or it was seen once) gets its recorded states.

        Args:
            frame: the present frame.
            variant: number of the report.
        """
        scene, tracks = self._frames.at(frame)
        if not len(tracks):
            return scene, tracks
        random = np.random.default_rng([self._seed, frame, variant])
        time = frame * STEP_SECONDS
        observed = self._observe(tracks, frame, _Draw.of(random), random)
        states = resample(observed, time, self._history_frames)
        usable = states.velocity_known & (states.first < states.frames) & np.isfinite(states.heading[:, -1])
        mixed = _where(usable, states, scene.states)
        return Scene(scene.types, mixed, scene.raster), tracks

    def _observe(self, tracks: Ints, frame: int, draw: _Draw, random: np.random.Generator) -> Observations:
        """Return the observations of some tracks, at least one, up to a frame."""
        count = int(_SPAN_S * draw.rate_hz) + 1
        rows = [self._observe_one(int(track), frame, count, draw, random) for track in tracks.tolist()]
        size = max(len(row.time) for row in rows)

        def padded(values: list[Floats], fill: float) -> Floats:
            result = np.full((len(values), size, *values[0].shape[1:]), fill)
            for row, one in zip(result, values, strict=True):
                row[: len(one)] = one
            return result

        unknown = [np.full(len(row.time), np.nan) for row in rows]
        return Observations(
            count=np.array([len(row.time) for row in rows], dtype=np.int64),
            time=padded([row.time for row in rows], np.inf),
            position=padded([row.position for row in rows], 0.0),
            heading=padded([row.heading for row in rows], np.nan),
            velocity=padded([row.velocity for row in rows], np.nan),
            acceleration=padded([np.stack([one, one], axis=-1) for one in unknown], np.nan),
            heading_rate=padded(unknown, np.nan),
        )

    def _observe_one(
        self, track: int, frame: int, count: int, draw: _Draw, random: np.random.Generator
    ) -> "_Report":
        """Return the report of one track up to a frame, with ``count`` observations before losses."""
        one = self._record.tracks[track]
        now = int(np.searchsorted(one.frames, frame))
        start = now
        while start > 0 and one.frames[start - 1] == one.frames[start] - 1 and now - start < 8:
            start -= 1
        past = slice(start, now + 1)
        ages = np.arange(count - 1, -1, -1) / draw.rate_hz
        ages = np.clip(ages + draw.jitter_s * random.uniform(-1, 1, count), 0.0, None)
        newest = ages[-1]
        ages[-1] = 0.0 if random.random() < 0.7 else newest
        known_s = STEP_SECONDS * (now - start)
        if random.random() < 0.25:  # first seen a moment ago
            known_s = min(known_s, random.uniform(0.0, 2.0))
        kept = ages <= known_s + 1e-9
        kept &= random.random(count) >= draw.lost_share
        kept[-1] = True
        ages = np.unique(ages[kept])[::-1]
        position, velocity = spline(one.position[past], ages)
        heading = interpolated_headings(one.heading[past], ages)
        size = len(ages)
        position = position + draw.position_noise_m * random.standard_normal((size, 2))
        heading = heading + draw.heading_noise_rad * random.standard_normal(size)
        velocity = velocity + draw.velocity_noise_mps * random.standard_normal((size, 2))
        if random.random() < 0.02:  # detectors now and then confuse front and back
            heading[random.integers(size)] += np.pi
        if random.random() < 0.1:
            heading = np.full(size, np.nan)
        if random.random() < 0.5 and size > 1:
            velocity = np.full((size, 2), np.nan)
        return _Report(frame * STEP_SECONDS - ages, position, wrap_angle(heading), velocity)


@dataclass(frozen=True)
class _Report:
    time: Floats  # [S]
    position: Floats  # [S, 2]
    heading: Floats  # [S]
    velocity: Floats  # [S, 2]


def spline(positions: Floats, ages: Floats) -> tuple[Floats, Floats]:
    """Return positions and velocities on the spline through poses 0.5 s apart; the last one is now.

    Args:
        positions: [P, 2], m, oldest first.
        ages: [S], s before now, at most those of the oldest pose.

    Returns:
        [S, 2] each, m and m/s; for a single pose the velocity is NaN.
    """
    count = len(positions)
    if count == 1:
        return np.repeat(positions, len(ages), axis=0), np.full((len(ages), 2), np.nan)
    tangents = np.gradient(positions, STEP_SECONDS, axis=0, edge_order=2 if count > 2 else 1)
    place = np.clip(count - 1 - ages / STEP_SECONDS, 0.0, count - 1)
    left = np.minimum(place.astype(np.int64), count - 2)
    u = (place - left)[:, None]
    a, b = positions[left], positions[left + 1]
    ma, mb = STEP_SECONDS * tangents[left], STEP_SECONDS * tangents[left + 1]
    position = (
        (2 * u**3 - 3 * u**2 + 1) * a
        + (u**3 - 2 * u**2 + u) * ma
        + (3 * u**2 - 2 * u**3) * b
        + (u**3 - u**2) * mb
    )
    slope = (6 * u**2 - 6 * u) * (a - b) + (3 * u**2 - 4 * u + 1) * ma + (3 * u**2 - 2 * u) * mb
    return position, slope / STEP_SECONDS


def interpolated_headings(headings: Floats, ages: Floats) -> Floats:
    """Return headings interpolated between poses 0.5 s apart, along the shorter arc: [S], rad."""
    turned = np.unwrap(headings)
    place = len(headings) - 1 - ages / STEP_SECONDS
    result: Floats = np.interp(place, np.arange(len(headings), dtype=np.float64), turned)
    return result


def _where(chosen: Bools, some: AgentStates, others: AgentStates) -> AgentStates:
    """Return each agent's states [N], from the first argument where it is chosen, else from the second."""

    def pick(one: Any, another: Any) -> Any:
        return np.where(chosen.reshape(-1, *[1] * (one.ndim - 1)), one, another)

    return AgentStates(
        **{part.name: pick(getattr(some, part.name), getattr(others, part.name)) for part in fields(some)}
    )
