"""Recorded scenes, independent of the data set."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol as Interface

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.metrics.standing import STANDING_FRAMES, stood
from model.scenes.scene import AgentType, Raster


class DataError(Exception):
    """A fault in recorded data, which is missing or inconsistent; the text names the file."""


@dataclass(frozen=True)
class Track:
    """One agent over a scene, at 2 Hz."""

    id: str
    """Unique within the scene: the data set's instance token where it has one."""
    type: AgentType
    frames: Ints
    """[F], ascending numbers of the scene's 2 Hz frames; gaps where it was not annotated."""
    position: Floats
    """[F, 2], m, ground frame."""
    heading: Floats
    """[F], rad."""

    def positions(self, frames: Ints) -> Floats:
        """Return positions at frames [...]: [..., 2], m, ground frame; NaN where not annotated."""
        row, there = self._rows(frames)
        return np.where(there[..., None], self.position[row], np.nan)

    def headings(self, frames: Ints) -> Floats:
        """Return headings at frames [...]: [...], rad; NaN where not annotated."""
        row, there = self._rows(frames)
        return np.where(there, self.heading[row], np.nan)

    def _rows(self, frames: Ints) -> tuple[Ints, Bools]:
        """Return the row of each frame, and whether the track has it: [...] each."""
        row = np.minimum(np.searchsorted(self.frames, frames), len(self.frames) - 1)
        return row, np.asarray(self.frames[row] == frames)


@dataclass(frozen=True)
class Pair:
    """An agent and a frame to forecast from, as the prediction challenge lists them."""

    track: int
    """Index into the scene's tracks."""
    frame: int
    """Number of the present 2 Hz frame."""
    token: str = ""
    """"instance_sample" as in the official lists; empty where the data has no tokens."""


@dataclass(frozen=True)
class SceneRecord:
    """One scene."""

    name: str
    tracks: Sequence[Track]
    pairs: Sequence[Pair]
    """Pairs of the split that was read, ordered by frame, then by track."""
    raster: Raster

    def stood(self, pairs: Sequence[Pair]) -> Bools:
        """Return which pairs' agents stood before now (``model.metrics.standing``): [N].

        Args:
            pairs: N pairs of this scene.
        """
        back = np.arange(-STANDING_FRAMES, 1)
        return stood(np.stack([self.tracks[pair.track].positions(pair.frame + back) for pair in pairs]))


class Reader(Interface):
    """A reader of the scenes of a data set."""

    @property
    def place(self) -> str:
        """Place of the data; it identifies the data in caches."""
        ...

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits."""
        ...

    def scene_count(self, split: str) -> int:
        """Return the number of scenes of a split, or a little more where some turn out to have no pairs.

        Raises:
            DataError: there is no such split, or the data is missing.
        """
        ...

    def scenes(self, split: str) -> Iterator[SceneRecord]:
        """Yield the scenes of a split that have pairs, in order of their names.

        Raises:
            DataError: there is no such split, or a file is missing or bad; names it.
        """
        ...
