"""What is asked of the endpoint: calls of one scene and frame each."""

import hashlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.data.checks import STEPS_AHEAD, check_pairs
from model.data.scenes import DataError, Pair, Reader, SceneRecord

HISTORY_FRAMES = 5
"""Frames of a full history, now included (the paper's H = 4 past ones)."""


@dataclass(frozen=True)
class Call:
    """Forecasts of some agents of one frame."""

    frame: int
    tracks: tuple[int, ...]
    """Those to be forecast: indices into the scene's tracks, ascending."""
    due: frozenset[int]
    """Those of them that the challenge asks for at this frame. The others are asked for dispersion and
    convergence, which look at an agent's most likely trajectory alone."""


@dataclass(frozen=True)
class PlannedScene:
    """A recorded scene and the calls about it."""

    record: SceneRecord
    pairs: Sequence[Pair]
    """The challenge's that are asked for, ordered by frame, then by track."""
    first: int
    """Number of its first pair among those of all scenes."""
    calls: tuple[Call, ...]
    """Ordered by frame."""

    @property
    def forecasts(self) -> int:
        """How many are asked of each model."""
        return sum(len(call.tracks) for call in self.calls)

    def truth(self) -> Floats:
        """[N, 12, 2], m, ground frame: where the pairs' agents went."""
        return self._positions(STEPS_AHEAD)

    def origin(self) -> Floats:
        """[N, 2], m, ground frame: where the pairs' agents are."""
        return self._positions(np.array(0))

    def stood(self) -> Bools:
        """[N], whether the pairs' agents stood before now (``model.metrics.standing``)."""
        return self.record.stood(self.pairs)

    def _positions(self, ahead: Ints) -> Floats:
        """Where the pairs' agents are so many frames later: [N, ..., 2], m."""
        tracks = self.record.tracks
        return np.stack([tracks[pair.track].positions(pair.frame + ahead) for pair in self.pairs])


def plan_scenes(
    reader: Reader, split: str, *, consistency: bool = True, limit: int | None = None
) -> Iterator[PlannedScene]:
    """Plans the scenes of a split, in order.

    Args:
        reader: of the data.
        split: one of the reader's.
        consistency: also ask for every agent that has pairs, at every frame at which it has a full history.
        limit: how many of the first pairs; None: all.

    Raises:
        DataError: the data is bad, or the split has no pairs.
    """
    first = 0
    for record in reader.scenes(split):
        check_pairs(record.name, record.tracks, record.pairs)
        pairs = record.pairs if limit is None else record.pairs[: limit - first]
        yield PlannedScene(record, pairs, first, tuple(_calls(record, pairs, consistency)))
        first += len(pairs)
        if first == limit:
            return
    if not first:
        raise DataError(f"the split {split!r} has no pairs")


def digest(scenes: Sequence[PlannedScene]) -> str:
    """What is asked, and of what data, as one hexadecimal number: answers of another plan have another."""
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
    """Those of a track's frames before which, too, it was seen without a break for a full history.

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
    asked = {frame: set(tracks) for frame, tracks in due.items()}
    if consistency:
        for track in {pair.track for pair in pairs}:
            for frame in full_history(record.tracks[track].frames).tolist():
                asked.setdefault(frame, set()).add(track)
    for frame in sorted(asked):
        yield Call(frame, tuple(sorted(asked[frame])), frozenset(due.get(frame, ())))
