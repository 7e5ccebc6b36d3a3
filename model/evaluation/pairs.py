"""The challenge pairs of a split, scene by scene."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import Floats, Ints
from model.data.checks import STEPS_AHEAD, check_pairs
from model.data.scenes import DataError, Pair, Reader, SceneRecord
from model.metrics.pairs import EvaluatedPairs


@dataclass(frozen=True)
class ScenePairs:
    """A recorded scene with N of its pairs."""

    record: SceneRecord
    pairs: Sequence[Pair]
    """Ordered by frame, then by track."""
    first: int
    """Index of its first pair in the split."""

    def truth(self) -> Floats:
        """Return the future positions of the pairs' agents: [N, 12, 2], m, ground frame."""
        return self._positions(STEPS_AHEAD)

    def origin(self) -> Floats:
        """Return the present positions of the pairs' agents: [N, 2], m, ground frame."""
        return self._positions(np.array(0))

    def evaluated(self) -> EvaluatedPairs:
        """Return the pairs with their ground truth."""
        numbers = np.arange(self.first, self.first + len(self.pairs))
        rasters = [self.record.raster] * len(self.pairs)
        return EvaluatedPairs(numbers, self.truth(), rasters, self.record.stood(self.pairs))

    def _positions(self, ahead: Ints) -> Floats:
        """Return the positions of the pairs' agents ``ahead`` frames later: [N, ..., 2], m."""
        tracks = self.record.tracks
        return np.stack([tracks[pair.track].positions(pair.frame + ahead) for pair in self.pairs])


def split_pairs(reader: Reader, split: str, limit: int | None = None) -> Iterator[ScenePairs]:
    """Yield the scenes of a split with their pairs, in the order of a cache.

    Args:
        reader: reader of the data.
        split: one of the reader's splits.
        limit: number of pairs, from the first; None: all.

    Raises:
        DataError: the data is invalid, or the split has no pairs.
    """
    first = 0
    for record in reader.scenes(split):
        check_pairs(record.name, record.tracks, record.pairs)
        pairs = record.pairs if limit is None else record.pairs[: limit - first]
        yield ScenePairs(record, pairs, first)
        first += len(pairs)
        if first == limit:
            return
    if not first:
        raise DataError(f"the split {split!r} has no pairs")
