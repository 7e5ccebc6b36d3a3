"""Scenes that move, tick by tick: simulated ones, and recorded ones."""

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import cycle
from typing import Protocol

import numpy as np
import numpy.typing as npt

from cab.forecast.v1.model_service_pb2 import AgentType
from cab.forecast.v1.prediction_service_pb2 import Agent, AgentState, PredictRequest, SceneRaster
from cab_forecast.demo.simulation import Simulation, User
from cab_forecast.demo.world import Kind
from cab_forecast.requests import TypeName, agent, predict_request

HISTORY_SECONDS = 2.0
_TYPES: Mapping[Kind, AgentType.ValueType] = {
    "vehicle": AgentType.AGENT_TYPE_VEHICLE,
    "cyclist": AgentType.AGENT_TYPE_CYCLIST,
    "pedestrian": AgentType.AGENT_TYPE_PEDESTRIAN,
}
_MAX_STEP = 0.1
"""Longest step of a simulation, s."""


class Ticks(Protocol):
    """A scene that goes on, tick by tick."""

    @property
    def rate(self) -> float:
        """Ticks a second."""
        ...

    def tick(self, now: float) -> PredictRequest:
        """Go on by one tick, and return the request of it.

        Args:
            now: the tick's time, s since the epoch.
        """
        ...


class SimulatedTicks:
    """Ticks of a simulation, with histories of 2 s at the rate of the ticks."""

    def __init__(self, simulation: Simulation, rate: float = 10.0) -> None:
        """
        Args:
            simulation: the traffic.
            rate: ticks a second.
        """
        self._simulation = simulation
        self.rate = rate
        self._steps = math.ceil(1 / (rate * _MAX_STEP) - 1e-9)
        self._tracks: dict[str, deque[AgentState]] = {}

    def tick(self, now: float) -> PredictRequest:
        """Go on by one tick, and return the request of it, see ``Ticks``."""
        for _ in range(self._steps):
            self._simulation.step(1 / (self.rate * self._steps))
        agents = [self._agent(user, now) for user in self._simulation.users]
        present = {agent.id for agent in agents}
        self._tracks = {name: track for name, track in self._tracks.items() if name in present}
        world = self._simulation.world
        return predict_request(now, agents, scene_id=f"demo/{world.name}", raster=world.raster)

    def _agent(self, user: User, now: float) -> Agent:
        track = self._tracks.setdefault(user.name, deque(maxlen=round(HISTORY_SECONDS * self.rate) + 1))
        x, y = user.position.tolist()
        velocity_x, velocity_y = user.velocity
        track.append(
            AgentState(time=now, x=x, y=y, heading=user.heading, velocity_x=velocity_x, velocity_y=velocity_y)
        )
        return Agent(id=user.name, type=_TYPES[user.kind], states=track, predict=True)


@dataclass(frozen=True)
class RecordedTrack:
    """A recorded road user."""

    name: str
    type: TypeName
    frames: npt.NDArray[np.int64]
    """[F], numbers of the frames in which it was seen, ascending."""
    positions: npt.NDArray[np.float64]
    """[F, 2], m."""
    headings: npt.NDArray[np.float64]
    """[F], rad."""


@dataclass(frozen=True)
class Recording:
    """A recorded scene, with a frame every 0.5 s."""

    name: str
    tracks: tuple[RecordedTrack, ...]
    raster: SceneRaster


class RecordedTicks:
    """Ticks of recorded scenes, one after the other and without end, at the 2 Hz of their annotations.

    Nothing is interpolated: the agents and states are those of the recording.
    """

    rate = 2.0

    def __init__(self, recordings: Iterable[Recording]) -> None:
        """
        Args:
            recordings: the scenes; they are kept, so that they begin again after the last one.
        """
        self._requests = self._play(cycle(recordings))

    def tick(self, now: float) -> PredictRequest:
        """Go on by one frame, and return the request of it, see ``Ticks``."""
        recording, frame = next(self._requests)
        agents = [
            self._agent(track, frame, now) for track in recording.tracks if np.isin(frame, track.frames)
        ]
        return predict_request(now, agents, scene_id=f"demo/{recording.name}", raster=recording.raster)

    @staticmethod
    def _play(recordings: Iterator[Recording]) -> Iterator[tuple[Recording, int]]:
        for recording in recordings:
            frames = np.unique(np.concatenate([track.frames for track in recording.tracks]))
            yield from ((recording, frame) for frame in range(int(frames[0]), int(frames[-1]) + 1))

    def _agent(self, track: RecordedTrack, frame: int, now: float) -> Agent:
        seen = (track.frames <= frame) & (track.frames >= frame - HISTORY_SECONDS * self.rate)
        times = now + (track.frames[seen] - frame) / self.rate
        return agent(track.name, track.type, times, track.positions[seen], headings=track.headings[seen])
