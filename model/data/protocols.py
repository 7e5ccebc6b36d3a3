"""Frames of a recorded scene as forecasters see them, under the two protocols of the inputs.

Both go through ``model.scenes.resample``, as the server's requests do, so that training and serving share one
derivation.

- causal: positions and headings up to the present are given. The rest is derived from them, as for a client
  that sends no derivatives.
- paper: velocity, acceleration and heading rate are given as well, by central differences over the *whole*
  track. They contain the next one or two positions, and so are for comparison with published tables only.
"""

from dataclasses import dataclass

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.data.scenes import SceneRecord
from model.forecaster import Protocol
from model.geometry import wrap_angle
from model.scenes.observations import Observations
from model.scenes.resample import resample
from model.scenes.scene import STEP_SECONDS, AgentStates, Scene

_OLDER_FRAMES = 4
"""Frames before the history on which its states can depend: two for differences, and one or two from which a
lost frame is interpolated. Older frames change nothing."""


def frame_scene(
    record: SceneRecord, frame: int, protocol: Protocol, history_frames: int
) -> tuple[Scene, Ints]:
    """Return the scene at a frame, as ``SceneFrames.at`` does; for many frames, use that.

    Returns:
        The agents of the frame, and the index of each one's track [N], ascending.
    """
    return SceneFrames(record, protocol, history_frames).at(frame)


class SceneFrames:
    """The scenes at all frames of one record."""

    def __init__(self, record: SceneRecord, protocol: Protocol, history_frames: int) -> None:
        """
        Args:
            record: the recorded scene.
            protocol: protocol of the inputs.
            history_frames: F, frames of history, now included.
        """
        self._record = record
        self._history_frames = history_frames
        self._table = _tabulate(record, history_frames + _OLDER_FRAMES)
        self._derivatives = _central(self._table) if protocol is Protocol.PAPER else None

    def at(self, frame: int) -> tuple[Scene, Ints]:
        """Return the scene at a frame, and the index of each agent's track [N], ascending.

        Time is ``frame`` · 0.5 s. Agents that are not annotated at the frame are left out, as a client sends
        none that it has lost. So are those of unknown velocity (first seen at the frame, causal protocol),
        which the server refuses.
        """
        observations, seen = self._observed(frame)
        states = self._resampled(observations, frame)
        known = states.velocity_known
        seen = seen[known]
        types = [self._record.tracks[track].type for track in seen.tolist()]
        return Scene(types, states.select(known), self._record.raster), seen

    def observations(self, frame: int) -> tuple[Observations, Ints]:
        """Return observations of the agents of ``at``, as a client sends them, and their tracks' indices."""
        observations, seen = self._observed(frame)
        known = self._resampled(observations, frame).velocity_known
        return observations.select(known), seen[known]

    def _resampled(self, observations: Observations, frame: int) -> AgentStates:
        return resample(observations, frame * STEP_SECONDS, self._history_frames)

    def _observed(self, frame: int) -> tuple[Observations, Ints]:
        """Return observations of all agents annotated at a frame, and their tracks' indices [N]."""
        table = self._table
        window = self._history_frames + _OLDER_FRAMES
        now = frame - table.first_frame
        if not window <= now < table.present.shape[1]:
            seen = np.zeros(0, dtype=np.int64)
            now = window
        else:
            seen = np.flatnonzero(table.present[:, now])
        past = slice(now - window + 1, now + 1)
        present = table.present[seen, past]
        # Observations are padded at the end: frames that are there come first, in order
        order = np.argsort(~present, axis=1, kind="stable")
        rows = np.arange(len(seen))[:, None]
        padding = ~present[rows, order]

        def pick(values: Floats, fill: float) -> Floats:
            picked = values[seen, past][rows, order]
            picked[padding] = fill
            return picked

        times = STEP_SECONDS * np.arange(frame - window + 1, frame + 1, dtype=np.float64)[order]
        times[padding] = np.inf
        unknown = np.full((*present.shape, 2), np.nan)
        derived = self._derivatives
        observations = Observations(
            count=present.sum(axis=1),
            time=times,
            position=pick(table.position, 0.0),
            heading=pick(table.heading, np.nan),
            velocity=unknown if derived is None else pick(derived.velocity, np.nan),
            acceleration=unknown if derived is None else pick(derived.acceleration, np.nan),
            heading_rate=unknown[..., 0] if derived is None else pick(derived.heading_rate, np.nan),
        )
        return observations, seen


@dataclass(frozen=True)
class _Table:
    """All tracks of a scene over all its frames, preceded by empty frames."""

    first_frame: int
    """Frame of the first column."""
    present: Bools  # [N, L]
    position: Floats  # [N, L, 2], NaN where not present
    heading: Floats  # [N, L], NaN where not present


@dataclass(frozen=True)
class _Derivatives:
    velocity: Floats  # [N, L, 2]
    acceleration: Floats  # [N, L, 2]
    heading_rate: Floats  # [N, L]


def _tabulate(record: SceneRecord, front: int) -> _Table:
    tracks = record.tracks
    first = min((int(track.frames[0]) for track in tracks), default=0) - front
    last = max((int(track.frames[-1]) for track in tracks), default=0)
    shape = (len(tracks), last - first + 1)
    position, heading = np.full((*shape, 2), np.nan), np.full(shape, np.nan)
    present = np.zeros(shape, dtype=np.bool_)
    for row, track in enumerate(tracks):
        columns = track.frames - first
        present[row, columns] = True
        position[row, columns] = track.position
        heading[row, columns] = track.heading
    return _Table(first, present, position, heading)


def _central(table: _Table) -> _Derivatives:
    """Return derivatives by central differences over whole tracks."""
    velocity = _mean_of_differences(np.diff(table.position, axis=1), table.present)
    acceleration = _mean_of_differences(np.diff(velocity, axis=1), table.present)
    turned = wrap_angle(np.diff(table.heading, axis=1))  # differences of the unwrapped heading
    return _Derivatives(velocity, acceleration, _mean_of_differences(turned, table.present))


def _mean_of_differences(differences: Floats, present: Bools) -> Floats:
    """Return rates of change by central differences (``np.gradient`` of every unbroken run).

    A rate is the mean of the differences to the frames before and after; at the ends of a run, the only
    difference; in a run of one frame, zero; NaN where not present.

    Args:
        differences: [N, L − 1, …], NaN where either frame is not present.
        present: [N, L].
    """
    none = np.full_like(differences[:, :1], np.nan)
    both = np.stack([np.concatenate([none, differences], 1), np.concatenate([differences, none], 1)])
    known = np.isfinite(both)
    rate = np.where(known, both, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1) / STEP_SECONDS
    rate[~present] = np.nan
    result: Floats = rate
    return result
