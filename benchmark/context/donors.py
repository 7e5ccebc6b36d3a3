"""Donors: agents of other scenes, whose map or whose neighbours an agent is given.

A donor drives about as fast as the agent (± 1 m/s), so that the wrong context is a likely one. A donor of a
map has driveable ground under the agent's past; a donor of neighbours has at least as many, and those that
are given do not run into the agent's past. Donors depend on the seed and the pair alone, not on the model.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from benchmark.context.moves import Move, Pose
from benchmark.plan import HISTORY_FRAMES, PlannedScene
from model.arrays import Floats, Ints
from model.explanation.matching import NEIGHBORS_M, alike, overlaps
from model.metrics.offroad import driveable
from model.scenes.scene import STEP_SECONDS

TRIES: Final = 200
"""Candidates that are tried for an agent."""

_BACK: Final = np.arange(1 - HISTORY_FRAMES, 1)


@dataclass(frozen=True)
class Agent:
    """The agent of a pair, as donors are chosen for it."""

    scene: int
    """Index of its scene."""
    track: int
    frame: int
    pose: Pose
    past: Floats
    """[5, 2], m, positions up to now; NaN where not seen."""
    past_heading: Floats
    """[5], rad, likewise."""

    @property
    def speed(self) -> float:
        """m/s, from the last two positions; NaN if not seen at the frame before now."""
        return float(np.hypot(*(self.past[-1] - self.past[-2]))) / STEP_SECONDS


class DonorPool:
    """The agents of all pairs of a split, each a donor for those of other scenes.

    Args:
        scenes: the planned scenes.
        seed: seed of the choice.
    """

    def __init__(self, scenes: Sequence[PlannedScene], seed: int) -> None:
        self.scenes = scenes
        self._seed = seed
        self._neighbors: dict[int, Ints] = {}

    @cached_property
    def agents(self) -> list[Agent]:
        """The agents of the pairs, by the pair's index in the split."""
        return [
            _agent(scene, number, index)
            for index, scene in enumerate(self.scenes)
            for number in range(len(scene.pairs))
        ]

    @cached_property
    def _speeds(self) -> Floats:
        return np.array([agent.speed for agent in self.agents])

    @cached_property
    def _scene_of(self) -> Ints:
        return np.array([agent.scene for agent in self.agents], dtype=np.int64)

    def random(self, number: int, purpose: int) -> np.random.Generator:
        """Return a generator of random numbers of its own for a pair and a purpose."""
        return np.random.default_rng([self._seed, number, purpose])

    def map_donors(self, number: int, count: int) -> list[int]:
        """Return the indices of up to ``count`` pairs whose agents' maps a pair's agent may be given.

        Args:
            number: index of the pair in the split.
            count: number of donors; there may be fewer.
        """
        agent = self.agents[number]
        past = agent.past[np.isfinite(agent.past[:, 0])]
        found: list[int] = []
        for candidate in self._candidates(number, 0):
            donor = self.agents[candidate]
            raster = self.scenes[donor.scene].record.raster
            if driveable(raster, Move(agent.pose, donor.pose).points(past)).all():
                found.append(candidate)
                if len(found) == count:
                    break
        return found

    def neighbor_donors(self, number: int, count: int) -> list[tuple[int, Ints]]:
        """Return up to ``count`` pairs whose agents' neighbours a pair's agent may be given.

        Args:
            number: index of the pair in the split.
            count: number of donors; there may be fewer, and none for an agent without neighbours.

        Returns:
            The indices of the pairs, each with the neighbours' tracks in its scene, the nearest ones, as many
            as the agent has.
        """
        size = len(self.neighbors(number))
        found: list[tuple[int, Ints]] = []
        if not size:
            return found
        for candidate in self._candidates(number, 1):
            if len(self.neighbors(candidate)) < size:
                continue
            free = self._free_neighbors(self.agents[number], candidate)
            if len(free) >= size:
                found.append((candidate, free[:size]))
                if len(found) == count:
                    break
        return found

    def neighbors(self, number: int) -> Ints:
        """Return the tracks of a pair's neighbours, nearest first.

        They are the agents within ``NEIGHBORS_M`` that were seen now and at the frame before, so that their
        velocity is known.

        Args:
            number: index of the pair in the split.
        """
        if number not in self._neighbors:
            agent = self.agents[number]
            tracks = self.scenes[agent.scene].record.tracks
            frames = np.array([agent.frame - 1, agent.frame])
            seen = np.stack([track.positions(frames) for track in tracks])  # [N, 2, 2]
            distance = np.hypot(*(seen[:, 1] - agent.pose.position).T)
            near = np.isfinite(seen).all(axis=(1, 2)) & (distance <= NEIGHBORS_M)
            near[agent.track] = False
            order = np.argsort(np.where(near, distance, np.inf), kind="stable")
            self._neighbors[number] = order[: int(near.sum())].astype(np.int64)
        return self._neighbors[number]

    def _candidates(self, number: int, purpose: int) -> Iterator[int]:
        """Yield agents of other scenes and a like speed, in random order."""
        agent = self.agents[number]
        like = alike(self._speeds, agent.speed)
        others = np.flatnonzero(like & (self._scene_of != agent.scene))
        yield from self.random(number, purpose).permutation(others)[:TRIES].tolist()

    def _free_neighbors(self, agent: Agent, candidate: int) -> Ints:
        """Return those tracks of a donor's neighbours that do not overlap with the agent's past."""
        donor, tracks = self.agents[candidate], self.neighbors(candidate)
        record = self.scenes[donor.scene].record
        seen = np.stack([record.tracks[track].positions(donor.frame + _BACK) for track in tracks])
        moved = Move(donor.pose, agent.pose).points(seen)
        free: Ints = tracks[~overlaps(moved, agent.past, agent.past_heading)]
        return free


def _agent(scene: PlannedScene, number: int, index: int) -> Agent:
    pair = scene.pairs[number]
    track = scene.record.tracks[pair.track]
    past, headings = track.positions(pair.frame + _BACK), track.headings(pair.frame + _BACK)
    return Agent(index, pair.track, pair.frame, Pose(past[-1], float(headings[-1])), past, headings)
