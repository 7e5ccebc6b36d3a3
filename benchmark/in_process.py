"""Replay of the planned calls by forecasters in this process, without an endpoint.

Forecasters see the same agents and the same part of the map as in a request to an endpoint. Their answers
are saved like those of an endpoint, so that evaluation, tables and report are the same.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchmark.archive import Answer, Archive
from benchmark.plan import Call, PlannedScene
from benchmark.replay import Replayed, keep_most_likely
from benchmark.requests import crop
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Ints
from model.data.checks import FUTURE_STEPS
from model.data.protocols import SceneFrames
from model.forecaster import Forecaster, Protocol
from model.mixture import TrajectoryMixture
from model.scenes.scene import STEP_SECONDS


def replay_in_process(
    scenes: Sequence[PlannedScene],
    forecasters: Mapping[str, Forecaster],
    protocol: Protocol,
    archive: Archive,
    tick: Callable[[int], None] = lambda forecasts: None,
) -> Replayed:
    """Forecast all calls that have no saved answer.

    Args:
        scenes: the planned scenes.
        forecasters: forecasters by ``name@version``.
        protocol: protocol of the inputs.
        archive: the saved answers.
        tick: called with the number of forecasts of every call, saved ones included.
    """
    done = archive.answered()
    replayed = Replayed()
    started = time.perf_counter()
    history_frames = max(one.info.history_frames for one in forecasters.values())
    for scene in scenes:
        frames = SceneFrames(scene.record, protocol, history_frames)
        for call in scene.calls:
            for key, forecaster in forecasters.items():
                if (key, scene.record.name, call.frame) not in done:
                    archive.add(key, scene.record.name, call, _answer(forecaster, frames, scene, call))
                    replayed.requested += len(call.tracks)
                tick(len(call.tracks))
    replayed.seconds = time.perf_counter() - started
    return replayed


def _answer(forecaster: Forecaster, frames: SceneFrames, scene: PlannedScene, call: Call) -> Answer:
    started = time.perf_counter()
    observed, present = frames.at(call.frame)
    tracks = present[np.isin(present, call.tracks)]
    rows = np.searchsorted(present, tracks)
    response = pb.PredictResponse(time=call.frame * STEP_SECONDS, steps=FUTURE_STEPS, step=STEP_SECONDS)
    if len(rows):
        states = observed.states.last_frames(forecaster.info.history_frames)
        visible = crop(scene.record.raster, states.position[rows, -1])
        observed = replace(observed, states=states, raster=visible)
        mixture = forecaster(observed, rows, steps=FUTURE_STEPS)
        history_frames = states.frames - states.first[rows]
        ids = [scene.record.tracks[track].id for track in tracks.tolist()]
        response.forecasts.extend(_forecasts(mixture, ids, history_frames, forecaster.info.history_frames))
        keep_most_likely(response, call, scene)
    seconds = time.perf_counter() - started
    response.timing.inference = seconds
    response.timing.batch_agents = len(rows)
    return Answer(seconds, response)


def _forecasts(
    mixture: TrajectoryMixture, ids: Sequence[str], history_frames: Ints, full_history: int
) -> Iterator[pb.AgentForecast]:
    """Yield a message for each of N agents.

    Args:
        mixture: N forecasts.
        ids: N agents' ids.
        history_frames: [N], frames of history of the agents.
        full_history: frames of history that the model uses at most.
    """
    weights = mixture.log_weights.double().softmax(dim=1).numpy()
    means = mixture.world_means.numpy()
    covariances = mixture.covariances.double().numpy()[..., [0, 0, 1], [0, 1, 1]]
    for row, (agent_id, frames) in enumerate(zip(ids, history_frames.tolist(), strict=True)):
        short = frames < full_history
        yield pb.AgentForecast(
            agent_id=agent_id,
            status=pb.FORECAST_STATUS_SHORT_HISTORY if short else pb.FORECAST_STATUS_OK,
            history_frames=frames,
            mode_ids=range(weights.shape[1]),
            weights=weights[row].tolist(),
            means=means[row].ravel().tolist(),
            covariances=covariances[row].ravel().tolist(),
            most_likely_mode=int(weights[row].argmax()),
        )
