"""The forecasts that a benchmark requests: calls of one scene and frame each."""

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import Ints
from model.data.scenes import Pair, Reader, SceneRecord
from model.evaluation.pairs import ScenePairs, split_pairs

HISTORY_FRAMES = 5
"""Frames of a full history, including now (the paper's H = 4 past ones)."""


@dataclass(frozen=True)
class Call:
    """Forecasts of some agents at one frame."""

    frame: int
    tracks: tuple[int, ...]
    """Indices of the agents' tracks in the scene, ascending."""
    due: frozenset[int]
    """Tracks that are challenge pairs at this frame. The others are requested for dispersion and
    convergence, which need an agent's most likely trajectory only."""


@dataclass(frozen=True)
class PlannedScene(ScenePairs):
    """A recorded scene with its pairs and calls."""

    calls: tuple[Call, ...]
    """Ordered by frame."""

    @property
    def forecasts(self) -> int:
        """Number of forecasts requested of each model."""
        return sum(len(call.tracks) for call in self.calls)


def plan_scenes(
    reader: Reader, split: str, *, consistency: bool = True, limit: int | None = None
) -> Iterator[PlannedScene]:
    """Plan the scenes of a split, in order.

    Args:
        reader: reader of the data.
        split: one of the reader's splits.
        consistency: whether to request also every agent with pairs at every frame of full history.
        limit: number of pairs, from the first; None: all.

    Raises:
        DataError: the data is invalid, or the split has no pairs.
    """
    for scene in split_pairs(reader, split, limit):
        calls = tuple(_calls(scene.record, scene.pairs, consistency))
        yield PlannedScene(scene.record, scene.pairs, scene.first, calls)


def digest(scenes: Sequence[PlannedScene]) -> str:
    """Return a hexadecimal digest of the calls and their data."""
    whole = hashlib.sha256()
    for scene in scenes:
        whole.update(repr((scene.record.name, scene.first, scene.pairs, scene.calls)).encode())
        for track in scene.record.tracks:
            whole.update(repr((track.id, track.type.value)).encode())
            for values in (track.frames, track.position, track.heading):
                whole.update(np.ascontiguousarray(values).tobytes())
        raster = scene.record.raster
        whole.update(repr((raster.layers.shape, raster.origin.tolist(), raster.pixels_per_meter)).encode())
        whole.update(np.packbits(raster.layers).tobytes())
    return whole.hexdigest()


def full_history(frames: Ints) -> Ints:
    """Return the frames of a track at which it has an unbroken full history.

    Args:
        frames: [F], ascending.
    """
    back = HISTORY_FRAMES - 1
    late, early = frames[back:], frames[: max(len(frames) - back, 0)]
    full: Ints = late[late - early == back]
    return full


def _calls(record: SceneRecord, pairs: Sequence[Pair], consistency: bool) -> Iterator[Call]:
    due: dict[int, set[int]] = defaultdict(set)
    for pair in pairs:
        due[pair.frame].add(pair.track)
    requested = {frame: set(tracks) for frame, tracks in due.items()}
    if consistency:
        for track in {pair.track for pair in pairs}:
            for frame in full_history(record.tracks[track].frames).tolist():
                requested.setdefault(frame, set()).add(track)
    for frame in sorted(requested):
        yield Call(frame, tuple(sorted(requested[frame])), frozenset(due.get(frame, ())))
