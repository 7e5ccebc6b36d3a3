"""Tracks replayed through a live server, and the offline metrics of the same forecasts."""

import asyncio
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import model_service_pb2 as models
from cab.forecast.v1 import prediction_service_pb2 as pb
from cab_forecast import AsyncClient, Status, forecasts
from model.arrays import Floats
from model.metrics.consistency import (
    RANGES_M,
    complete,
    convergence_s,
    dispersion,
    errors_by_age_m,
    forecasts_by_age,
)


@dataclass(frozen=True)
class Track:
    """Positions of an agent in consecutive frames."""

    first: int
    """Number of the first frame."""
    position: Floats
    """[F, 2], m."""


@dataclass(frozen=True)
class Tracks:
    """One scene."""

    name: str
    start: float
    """Time of frame 0, s."""
    step: float
    """Seconds between frames; divides 0.5 s."""
    agents: Mapping[str, Track]
    history_s: float = 1.0
    """Seconds of history in a request."""

    def time(self, frame: int) -> float:
        """s."""
        return self.start + self.step * frame

    def frames(self) -> list[int]:
        """Return the frames with at least one agent."""
        ends = [(track.first, track.first + len(track.position)) for track in self.agents.values()]
        return list(range(min(first for first, _ in ends), max(end for _, end in ends)))

    def request(self, frame: int, model: str, newest_only: bool = False) -> pb.PredictRequest:
        """Return the request of a frame: its agents with their histories."""
        request = pb.PredictRequest(scene_id=self.name, time=self.time(frame), model=model)
        if newest_only:
            request.options.history = pb.HISTORY_SOURCE_MEMORY
        for agent_id, track in self.agents.items():
            last = frame - track.first
            if not 0 <= last < len(track.position):
                continue
            agent = request.agents.add(id=agent_id, type=models.AGENT_TYPE_VEHICLE)
            first = last if newest_only else max(last - round(self.history_s / self.step), 0)
            for at in range(first, last + 1):
                x, y = track.position[at].tolist()
                agent.states.add(time=self.time(track.first + at), x=x, y=y)
        return request


def at_rate(track: Track, parts: int) -> Track:
    """Return a track with several frames per frame, interpolated."""
    count = len(track.position)
    at = np.linspace(0, count - 1, (count - 1) * parts + 1)
    position = np.stack([np.interp(at, np.arange(count), track.position[:, k]) for k in (0, 1)], axis=1)
    return Track(track.first * parts, position)


def made_up(name: str, step: float = 0.5, seconds: float = 12.0, agents: int = 4) -> Tracks:
    """Return tracks of agents that swerve and brake, each appearing a second after the one before."""
    frames = round(seconds / step)
    tracks = {}
    for number in range(agents):
        first = round(number * 1.0 / step)
        t = step * np.arange(frames - first)
        x = 30.0 * number + 8.0 * t + 6.0 * np.sin(0.5 * t)
        tracks[f"agent {number}"] = Track(first, np.stack([x, 4.0 * np.sin(0.4 * t + number)], axis=1))
    return Tracks(name, 1.7e9, step, tracks)


def late(frames: Sequence[int], step: float, seconds: float) -> list[int]:
    """Return frames in the order of arrival if each is up to some seconds late."""
    rng = random.Random(len(frames))
    return sorted(frames, key=lambda frame: frame * step + rng.uniform(0, seconds))


@dataclass
class Replayed:
    """Results of a replay."""

    paths: dict[tuple[str, int], Floats] = field(default_factory=dict)
    """Likeliest path [T, 2], m, by agent and frame."""
    settled: dict[tuple[str, int], consistency_pb.InstantConsistency] = field(default_factory=dict)
    """Settled instants by agent and frame."""
    answers: dict[int, pb.PredictResponse] = field(default_factory=dict)
    """Responses by frame."""


class Watch:
    """Context manager that collects the settled instants of a scene."""

    def __init__(self, client: AsyncClient, tracks: Tracks, replayed: Replayed) -> None:
        self._client, self._tracks, self._replayed = client, tracks, replayed
        self._changed = asyncio.Event()

    async def __aenter__(self) -> "Watch":
        self._stream = await self._client.watch_scene(self._tracks.name).__aenter__()
        self._task = asyncio.create_task(self._read())
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stream.aclose()
        await self._task

    async def until(self, instants: int, seconds: float = 30.0) -> None:
        """Wait until that many instants have settled."""
        async with asyncio.timeout(seconds):
            while len(self._replayed.settled) < instants:
                await self._changed.wait()
                self._changed.clear()

    async def _read(self) -> None:
        async for event in self._stream:
            assert event.missed == 0
            for instant in event.instants:
                frame = round((instant.time - self._tracks.start) / self._tracks.step)
                if instant.settled:
                    self._replayed.settled.setdefault((instant.agent_id, frame), instant)
            self._changed.set()


async def replay(
    clients: Sequence[AsyncClient],
    tracks: Tracks,
    model: str,
    order: Sequence[int],
    *,
    newest_only: bool = False,
    into: Replayed | None = None,
) -> Replayed:
    """Send frames in an order, to the clients in turn."""
    replayed = into or Replayed()
    for turn, frame in enumerate(order):
        request = tracks.request(frame, model, newest_only)
        answer = await clients[turn % len(clients)].predict(request)
        replayed.answers[frame] = answer
        for agent_id, forecast in forecasts(answer).items():
            if forecast.status is not Status.INVALID:
                replayed.paths[agent_id, frame] = forecast.most_likely
    return replayed


def offline(tracks: Tracks, paths: Mapping[tuple[str, int], Floats]) -> dict[tuple[str, int], list[float]]:
    """Return the metrics of each complete set, by agent and frame: dispersion, C(τ), errors by age.

    At more than 2 Hz the frames of a track are several rows of frames 0.5 s apart.
    """
    rows = round(0.5 / tracks.step)
    found = {}
    for agent_id, track in tracks.agents.items():
        for row in range(rows):
            frames = np.arange(track.first, track.first + len(track.position))
            frames = frames[frames % rows == row]
            made = [frame for frame in frames.tolist() if (agent_id, frame) in paths]
            if not made:
                continue
            by_age = forecasts_by_age(
                np.array([frame // rows for frame in made]),
                np.stack([paths[agent_id, frame] for frame in made]),
                frames // rows,
            )
            errors_m = errors_by_age_m(by_age, track.position[frames - track.first])
            apart = dispersion(by_age)
            for at in np.flatnonzero(complete(by_age)).tolist():
                found[agent_id, int(frames[at])] = [
                    apart.std_m[at],
                    apart.mean_m[at],
                    apart.rms_m[at],
                    *(convergence_s(errors_m, range_m)[at] for range_m in RANGES_M),
                    *errors_m[at].tolist(),
                ]
    return found


def live(instant: consistency_pb.InstantConsistency) -> list[float]:
    """Return the same metrics of a server's message."""
    apart = instant.dispersion
    return [
        apart.standard_deviation,
        apart.mean,
        apart.root_mean_square,
        *(each.duration for each in instant.convergence),
        *(each.displacement_error for each in instant.errors),
    ]


async def check(tracks: Tracks, replayed: Replayed, watch: Watch) -> int:
    """Assert that the live metrics equal the offline ones to 1e-6, and return the number of sets."""
    expected = offline(tracks, replayed.paths)
    await watch.until(len(expected))
    assert replayed.settled.keys() == expected.keys()
    for key, figures in expected.items():
        np.testing.assert_allclose(live(replayed.settled[key]), figures, rtol=0, atol=1e-6)
    return len(expected)
