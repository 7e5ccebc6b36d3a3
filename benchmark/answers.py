"""Saved answers of one model about one scene, as arrays in the order of the pairs."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from benchmark.archive import Answer, Archive
from benchmark.errors import BenchmarkError
from benchmark.plan import PlannedScene, full_history
from cab_forecast import Forecast, forecasts
from model.arrays import Floats, Ints
from model.mixture import TrajectoryMixture

MISSING = "MISSING"
"""Status of a pair without a response; the other statuses are those of the contract."""


@dataclass(frozen=True)
class CallTimes:
    """Durations of C calls, [C] each."""

    seconds: Floats
    """Time that the client waited."""
    queue_seconds: Floats
    """Time before the model started."""
    inference_seconds: Floats
    """Time inside the model."""
    batch_agents: Floats
    """Agents in the batch of the call."""


@dataclass(frozen=True)
class SceneAnswers:
    """Answers of one model about one scene."""

    instances: Ints
    """[N], indices of the scene's pairs with a forecast, ascending."""
    mixture: TrajectoryMixture | None
    """Forecasts of these pairs; None: there are none."""
    statuses: Mapping[str, int]
    """Number of pairs by status."""
    lost: int
    """Missing forecasts among those requested for dispersion and convergence only."""
    most_likely: Mapping[int, tuple[Ints, Floats]]
    """Frames [F] of full history of each track, ascending, and the most likely trajectories [F, T, 2]
    forecast at these frames, m, ground frame."""
    times: CallTimes


def read_answers(archive: Archive, model: str, scene: PlannedScene) -> SceneAnswers:
    """Read the answers of a model about a scene.

    Args:
        archive: the saved answers.
        model: ``name@version``.
        scene: the planned scene.

    Raises:
        BenchmarkError: an answer contradicts itself, or does not fit its call.
    """
    try:
        return _read(archive, model, scene)
    except (ValueError, KeyError, IndexError) as error:
        where = f"{model}, {scene.record.name}"
        raise BenchmarkError(f"{where}: an answer does not fit its call: {error!r}") from error


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
    """Return frames, which the archive yields in order, and trajectories as arrays."""
    return np.array([frame for frame, _ in made], dtype=np.int64), np.stack([path for _, path in made])


def _mixture(found: Sequence[Forecast], origin: Floats) -> TrajectoryMixture:
    """Return forecasts as one batch.

    A forecast with fewer modes than others (a fallback) is padded with copies of its first mode of weight 0.
    """
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
    # Subtracting the origin restores the network's float32 values exactly
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
