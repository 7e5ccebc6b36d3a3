"""Cases: one pair each, with a map or neighbours that are not its own.

A case is a planned scene with one call, so that it is replayed and answered like those of the benchmark.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Final, overload

import numpy as np

from benchmark.context.donors import DonorPool
from benchmark.context.moves import Move, Pose
from benchmark.plan import Call, PlannedScene
from benchmark.requests import REACH_M
from model.arrays import Ints
from model.data.scenes import Pair, SceneRecord

SHIFT_M: Final = 0.2
"""m by which the map of the control is shifted, in a random direction."""
TURN: Final = np.deg2rad(1.0)
"""rad by which it is turned, to a random side."""
_MARGIN_M: Final = 1.0


class Change(StrEnum):
    """The part of the context that is not the agent's own."""

    MAP = "map"
    """Map of a donor."""
    NEIGHBORS = "neighbors"
    """Neighbours of a donor."""
    CONTROL = "control"
    """The agent's own map, shifted by 0.2 m and turned by 1°."""


@dataclass(frozen=True)
class ContextSettings:
    """Settings of the measurement of the use of the context."""

    donors: int = 2
    """Maximum number of donors of a map, and of neighbours, for each pair."""
    no_context: str = "trajectron-no-context"
    """``name`` or ``name@version`` of the model without context."""
    no_context_answers: Path | None = None
    """Folder of a benchmark with its answers; None: this one's."""


@dataclass(frozen=True)
class Case:
    """One pair with a changed context."""

    change: Change
    draw: int
    """Number among the pair's cases of that change."""
    number: int
    """Index of the pair in the split."""
    scene: int
    """Index of the scene that the map or the neighbours are from."""
    frame: int
    """Frame of the donor."""
    move: Move
    """From the donor's pose to that of the pair's agent."""
    tracks: Ints
    """Tracks of the donor's neighbours; empty where the map is changed."""

    @property
    def name(self) -> str:
        """Name that is unique in a run."""
        return f"{self.change.value}-{self.draw}/{self.number}"


class Cases(Sequence[PlannedScene]):
    """The cases of a split as planned scenes, which are made when they are taken: a map has 0.6 MB.

    Args:
        scenes: the planned scenes.
        donors: see ``ContextSettings``.
        seed: seed of the choice of donors.
        only: cases to keep; None: all.
    """

    def __init__(
        self, scenes: Sequence[PlannedScene], donors: int, seed: int, only: Sequence[Case] | None = None
    ) -> None:
        self._scenes = scenes
        self._donors = donors
        self._seed = seed
        self._only = only
        self._pool = DonorPool(scenes, seed)

    @cached_property
    def cases(self) -> Sequence[Case]:
        """All cases, those of one pair in succession."""
        if self._only is not None:
            return self._only
        return [case for number in range(len(self._pool.agents)) for case in self._cases(number)]

    @property
    def pool(self) -> DonorPool:
        """The agents of the pairs and the donors."""
        return self._pool

    def unanswered(self, answered: set[tuple[str, str, int]], models: Sequence[str]) -> "Cases":
        """Return the cases that a model has no answer about.

        Args:
            answered: model, case and frame of all answers, from ``Archive.answered``.
            models: ``name@version`` of the models.
        """
        left = [
            case
            for case in self.cases
            if any((m, case.name, self._pool.agents[case.number].frame) not in answered for m in models)
        ]
        return Cases(self._scenes, self._donors, self._seed, left)

    def __len__(self) -> int:
        return len(self.cases)

    @overload
    def __getitem__(self, index: int) -> PlannedScene: ...
    @overload
    def __getitem__(self, index: slice) -> list[PlannedScene]: ...
    def __getitem__(self, index: int | slice) -> PlannedScene | list[PlannedScene]:
        if isinstance(index, slice):
            return [self._planned(case) for case in self.cases[index]]
        return self._planned(self.cases[index])

    def _cases(self, number: int) -> Iterator[Case]:
        agent = self._pool.agents[number]
        none = np.zeros(0, dtype=np.int64)
        for draw, found in enumerate(self._pool.map_donors(number, self._donors)):
            donor = self._pool.agents[found]
            move = Move(donor.pose, agent.pose)
            yield Case(Change.MAP, draw, number, donor.scene, donor.frame, move, none)
        for draw, (found, tracks) in enumerate(self._pool.neighbor_donors(number, self._donors)):
            donor = self._pool.agents[found]
            move = Move(donor.pose, agent.pose)
            yield Case(Change.NEIGHBORS, draw, number, donor.scene, donor.frame, move, tracks)
        random = self._pool.random(number, 2)
        angle = random.uniform(-np.pi, np.pi)
        shifted = Pose(
            agent.pose.position + SHIFT_M * np.array([np.cos(angle), np.sin(angle)]),
            agent.pose.heading + random.choice([-TURN, TURN]),
        )
        move = Move(shifted, agent.pose)
        yield Case(Change.CONTROL, 0, number, agent.scene, agent.frame, move, none)

    def _planned(self, case: Case) -> PlannedScene:
        agent = self._pool.agents[case.number]
        record = self._scenes[agent.scene].record
        present = [
            (index, track)
            for index, track in enumerate(record.tracks)
            if index != agent.track and agent.frame in track.frames
        ]
        raster = record.raster
        source = self._scenes[case.scene].record
        if case.change is Change.NEIGHBORS:
            own = set(self._pool.neighbors(case.number).tolist())
            later = agent.frame - case.frame
            others = [track for index, track in present if index not in own]
            for index in case.tracks.tolist():
                track = source.tracks[index]
                others.append(case.move.track(track, f"donor-{track.id}", later))
        else:
            others = [track for _, track in present]
            raster = case.move.raster(source.raster, REACH_M + _MARGIN_M)
        pair = Pair(0, agent.frame)
        changed = SceneRecord(case.name, [record.tracks[agent.track], *others], [pair], raster)
        # Only the most likely trajectory is kept of what is not due
        return PlannedScene(changed, [pair], case.number, (Call(agent.frame, (0,), frozenset()),))
