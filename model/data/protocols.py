"""A frame of a recorded scene as forecasters see it, under either protocol of the inputs.

Both go through ``model.scenes.resample``, as the server's requests do, so that training and serving share one
derivation.

- causal: positions and headings up to the present; the rest is derived from them, as for a client that
  sends no derivatives.
- paper: velocity, acceleration and heading rate by central differences over the *whole* track are given
  beside them. These contain the next one to two positions: for comparison with published tables only.
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
"""Frames before the history that its states can depend on: two of differences, and the one or two that a
lost frame is interpolated from. What is older changes nothing."""


def frame_scene(
    record: SceneRecord, frame: int, protocol: Protocol, history_frames: int
) -> tuple[Scene, Ints]:
    """The scene at a frame. For many frames of one record, make ``SceneFrames`` once.

    Returns:
        The agents of that frame, and the index of each one's track [N], ascending: as ``SceneFrames.at``.
    """
    return SceneFrames(record, protocol, history_frames).at(frame)


class SceneFrames:
    """The scenes at all frames of one record."""

    def __init__(self, record: SceneRecord, protocol: Protocol, history_frames: int) -> None:
        """
        Args:
            record: the recorded scene.
            protocol: how derivatives are made.
            history_frames: F, frames of history, now included.
        """
        self._record = record
        self._history_frames = history_frames
        self._table = _tabulate(record, history_frames + _OLDER_FRAMES)
        self._derivatives = _central(self._table) if protocol is Protocol.PAPER else None

    def at(self, frame: int) -> tuple[Scene, Ints]:
        """The scene at a frame: as ``frame_scene``.

        Time is ``frame`` · 0.5 s. An agent that is not annotated at that frame is not there, as a client
        sends none that it has lost; nor is one whose velocity is not known (a first sight, causal), as the
        server refuses it.
        """
        observations, seen = self._observed(frame)
        states = self._resampled(observations, frame)
        known = states.velocity_known
        seen = seen[known]
        types = [self._record.tracks[track].type for track in seen.tolist()]
        return Scene(types, states.select(known), self._record.raster), seen

    def observations(self, frame: int) -> tuple[Observations, Ints]:
        """What a client would send of the agents that ``at`` shows, and the index of each one's track [N]."""
        observations, seen = self._observed(frame)
        known = self._resampled(observations, frame).velocity_known
        return observations.select(known), seen[known]

    def _resampled(self, observations: Observations, frame: int) -> AgentStates:
        return resample(observations, frame * STEP_SECONDS, self._history_frames)

    def _observed(self, frame: int) -> tuple[Observations, Ints]:
        """Observations of all that are annotated at a frame, and the index of each one's track [N]."""
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
        # Observations are padded behind: the frames that are there go first, in order
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
    """All tracks of a scene over all its frames, with empty frames in front."""

    first_frame: int
    """Of the first column."""
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
    velocity = _mean_of_differences(np.diff(table.position, axis=1), table.present)
    acceleration = _mean_of_differences(np.diff(velocity, axis=1), table.present)
    turned = wrap_angle(np.diff(table.heading, axis=1))  # of frame to frame: the unwrapped heading's
    return _Derivatives(velocity, acceleration, _mean_of_differences(turned, table.present))


def _mean_of_differences(differences: Floats, present: Bools) -> Floats:
    """Rate of change by central differences (``np.gradient`` of every unbroken run): the mean of the
    differences to the frames before and after; the one there is at the ends of a run; zero in a run of
    one frame; NaN where not present.

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
