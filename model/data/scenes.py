"""A recorded scene, whatever data set it is from."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol as Interface

import numpy as np

from model.arrays import Bools, Floats, Ints
from model.metrics.standing import STANDING_FRAMES, stood
from model.scenes.scene import AgentType, Raster


class DataError(Exception):
    """Recorded data is missing or makes no sense; the text names the file."""


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
        """Where it was at any frames [...]: [..., 2], m, ground frame; NaN where it was not annotated."""
        row = np.minimum(np.searchsorted(self.frames, frames), len(self.frames) - 1)
        there = self.frames[row] == frames
        return np.where(there[..., None], self.position[row], np.nan)


@dataclass(frozen=True)
class Pair:
    """An agent and a frame that the prediction challenge asks for."""

    track: int
    """Index into the scene's tracks."""
    frame: int
    """Number of the 2 Hz frame that is the present."""
    token: str = ""
    """"instance_sample" as in the official lists; empty where the data has no tokens."""


@dataclass(frozen=True)
class SceneRecord:
    """One scene."""

    name: str
    tracks: Sequence[Track]
    pairs: Sequence[Pair]
    """Of the split that was read, ordered by frame, then by track."""
    raster: Raster

    def stood(self, pairs: Sequence[Pair]) -> Bools:
        """Return which pairs' agents stood before now (``model.metrics.standing``): [N].

        Args:
            pairs: N of this scene's.
        """
        back = np.arange(-STANDING_FRAMES, 1)
        return stood(np.stack([self.tracks[pair.track].positions(pair.frame + back) for pair in pairs]))


class Reader(Interface):
    """Gives the scenes of a data set."""

    @property
    def place(self) -> str:
        """Where the data is: another place is other data."""
        ...

    @property
    def splits(self) -> tuple[str, ...]:
        """Names that ``scenes`` takes."""
        ...

    def scenes(self, split: str) -> Iterator[SceneRecord]:
        """The scenes of a split that have pairs, in order of their names.

        Raises:
            DataError: no such split, or a file is missing or bad; names it.
        """
        ...
