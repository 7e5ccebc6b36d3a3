"""Saved answers of one scene as arrays, in the order of what was asked."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from benchmark import BenchmarkError
from benchmark.archive import Answer, Archive
from benchmark.plan import PlannedScene, full_history
from cab_forecast import Forecast, forecasts
from model.arrays import Floats, Ints
from model.mixture import TrajectoryMixture

MISSING = "MISSING"
"""Status of an instance that was never answered; the others are the contract's."""


@dataclass(frozen=True)
class CallTimes:
    """Of C calls, [C] each."""

    seconds: Floats
    """That the client waited."""
    queue_seconds: Floats
    """Of these before the model started."""
    inference_seconds: Floats
    """Inside the model."""
    batch_agents: Floats
    """Agents in the batch that it rode in."""


@dataclass(frozen=True)
class SceneAnswers:
    """What one model said about one scene."""

    instances: Ints
    """[N], which of the scene's pairs have a forecast, ascending."""
    mixture: TrajectoryMixture | None
    """Of these; None: there are none."""
    statuses: Mapping[str, int]
    """How many pairs came out how."""
    lost: int
    """Forecasts that were asked for dispersion and convergence alone, and did not come."""
    likeliest: Mapping[int, tuple[Ints, Floats]]
    """By track: frames [F] at which it has a full history, ascending, and the most likely trajectories
    [F, T, 2] that were made there, m, ground frame."""
    times: CallTimes


def read_answers(archive: Archive, model: str, scene: PlannedScene) -> SceneAnswers:
    """Reads what is saved.

    Args:
        archive: of the answers.
        model: ``name@version``.
        scene: what was asked.

    Raises:
        BenchmarkError: an answer contradicts itself, or what was asked.
    """
    try:
        return _read(archive, model, scene)
    except (ValueError, KeyError, IndexError) as error:
        where = f"{model}, {scene.record.name}"
        raise BenchmarkError(f"{where}: an answer does not fit what was asked: {error!r}") from error


def _read(archive: Archive, model: str, scene: PlannedScene) -> SceneAnswers:
    tracks = {track.id: number for number, track in enumerate(scene.record.tracks)}
    numbers = {(pair.track, pair.frame): number for number, pair in enumerate(scene.pairs)}
    calls = {call.frame: call for call in scene.calls}
    full = [set(full_history(track.frames).tolist()) for track in scene.record.tracks]
    found: dict[int, Forecast] = {}
    paths: dict[int, list[tuple[int, Floats]]] = {}
    statuses: Counter[str] = Counter()
    others = 0
    answers: list[Answer] = []
    for frame, answer in archive.answers(model, scene.record.name):
        answers.append(answer)
        for forecast in forecasts(answer.response).values():
            track = tracks[forecast.agent_id]
            if track not in calls[frame].tracks:  # an invalid context agent
                continue
            due = track in calls[frame].due
            if due:
                statuses[forecast.status.value] += 1
            if not len(forecast.weights):
                continue
            if frame in full[track]:
                paths.setdefault(track, []).append((frame, forecast.most_likely))
            others += not due
            if due:
                found[numbers[track, frame]] = forecast
    statuses[MISSING] = len(scene.pairs) - sum(statuses.values())
    instances = np.array(sorted(found), dtype=np.int64)
    mixture = _mixture([found[number] for number in instances], scene.origin()[instances]) if found else None
    return SceneAnswers(
        instances,
        mixture,
        {status: count for status, count in statuses.items() if count},
        scene.forecasts - len(scene.pairs) - others,
        {track: _stacked(made) for track, made in paths.items()},
        _times(answers),
    )


def _stacked(made: Sequence[tuple[int, Floats]]) -> tuple[Ints, Floats]:
    """Frames, which the archive gives in order, and trajectories as arrays."""
    return np.array([frame for frame, _ in made], dtype=np.int64), np.stack([path for _, path in made])


def _mixture(found: Sequence[Forecast], origin: Floats) -> TrajectoryMixture:
    """Forecasts as one batch. One with fewer modes than others (a fallback) gets more of no weight, which are
    its first one over again."""
    modes = max(len(one.weights) for one in found)
    weights = np.zeros((len(found), modes))
    means, covariances = [], []
    for row, one in enumerate(found):
        kept = np.arange(modes)
        kept[len(one.weights) :] = 0
        weights[row, : len(one.weights)] = one.weights
        means.append(one.means[kept] - origin[row])
        covariances.append(one.covariances[kept])
    with np.errstate(divide="ignore"):
        log_weights = np.log(weights / weights.sum(axis=1, keepdims=True))
    # What a network computed in float32 comes back as it was: the rest is exact
    return TrajectoryMixture(
        torch.from_numpy(log_weights).float(),
        torch.from_numpy(np.stack(means)).float(),
        torch.from_numpy(np.stack(covariances)).float(),
        torch.from_numpy(origin),
    )


def _times(answers: Sequence[Answer]) -> CallTimes:
    timings = [one.response.timing for one in answers]
    return CallTimes(
        np.array([one.seconds for one in answers], dtype=np.float64),
        np.array([one.queue for one in timings], dtype=np.float64),
        np.array([one.inference for one in timings], dtype=np.float64),
        np.array([one.batch_agents for one in timings], dtype=np.float64),
    )
