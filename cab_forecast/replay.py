"""Replay of recorded calls: what another server or model answers to them, and how that differs."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from cab.forecast.v1.prediction_service_pb2 import HISTORY_SOURCE_REQUEST, PredictRequest, PredictResponse
from cab.forecast.v1.recording_pb2 import RecordedCall
from cab_forecast.client import Client
from cab_forecast.errors import BadRequest, DeadlineExceeded, InternalError, TooLarge
from cab_forecast.forecast import Forecast, Status, forecasts, model_name

_Floats = npt.NDArray[np.float64]


@dataclass
class Difference:
    """Difference between two responses to one request, the largest over its agents.

    Forecasts of one model are compared mode by mode. Modes of different models have nothing in common: then
    the most likely ones are compared.
    """

    agents: int = 0
    """Number of agents whose forecasts were compared."""
    position_m: float = 0.0
    """Max distance between means at the same step, and between samples, m."""
    weight: float = 0.0
    """Max difference of a mode's weight; the whole weight of a mode that one response lacks."""
    sigma_m: float = 0.0
    """Max difference of a standard deviation along x or y, m."""
    others: list[str] = field(default_factory=list)
    """Differences of another kind, in words: a status, a missing agent, a failed call."""

    def within(self, tolerance: float) -> bool:
        """Return whether all is equal but for the tolerance: in m, and of weights as a number."""
        return not self.others and max(self.position_m, self.weight, self.sigma_m) <= tolerance


@dataclass(frozen=True)
class Replayed:
    """A recorded call, and what the replay gave."""

    call: RecordedCall
    difference: Difference


def replay(client: Client, calls: Iterable[RecordedCall], model: str | None = None) -> Iterator[Replayed]:
    """Send recorded calls one after the other, and compare the responses with the recorded ones.

    Args:
        client: the client of the server to ask.
        calls: the calls, from ``cab_forecast.recordings.read_recording``.
        model: ``name`` or ``name@version``; None: the model and version that answered the recorded call.

    Raises:
        ForecastError: the server is unreachable, overloaded, or has no such model. Calls that it refuses or
            cannot answer are differences instead.
    """
    for call in calls:
        try:
            response = client.predict(replay_request(call, model))
        except (BadRequest, TooLarge, DeadlineExceeded, InternalError) as error:
            yield Replayed(call, Difference(others=[str(error)]))
        else:
            yield Replayed(call, compare(call.response, response))


def replay_request(call: RecordedCall, model: str | None = None) -> PredictRequest:
    """Return a request to which the same model gives the same forecasts on any server.

    The histories that came from the track memory are in it, and so is the seed that was drawn. It names no
    scene, so it leaves no traces in a track memory.

    Args:
        call: the recorded call.
        model: ``name`` or ``name@version``; None: the model and version that answered the recorded call.
    """
    request = PredictRequest()
    request.CopyFrom(call.request)
    recalled = {history.agent_id: history.states for history in call.recalled}
    for agent in request.agents:
        if agent.id in recalled:
            del agent.states[:]
            agent.states.extend(recalled[agent.id])
    request.options.history = HISTORY_SOURCE_REQUEST
    request.options.consistency = False
    request.scene_id = ""
    if request.options.samples:
        request.options.seed = call.response.seed
    request.model = model or model_name(call.response.model)
    return request


def compare(recorded: PredictResponse, replayed: PredictResponse) -> Difference:
    """Return how the second of two responses to one request differs from the first.

    Raises:
        ValueError: sizes in a response contradict each other.
    """
    before, after = forecasts(recorded), forecasts(replayed)
    difference = Difference()
    for agent_id, forecast in before.items():
        other = after.get(agent_id)
        if other is None:
            difference.others.append(f"{agent_id}: not in the answer")
            continue
        if forecast.status is not other.status:
            difference.others.append(f"{agent_id}: {_status(forecast)} → {_status(other)}")
        if len(forecast.weights) and len(other.weights):
            difference.agents += 1
            _add(difference, forecast, other)
    difference.others += [f"{agent_id}: only in the answer" for agent_id in after.keys() - before.keys()]
    return difference


def _add(difference: Difference, before: Forecast, after: Forecast) -> None:
    """Add the difference of one agent's forecasts."""
    steps = min(len(before.times), len(after.times))
    if before.model == after.model:
        _, rows, other_rows = np.intersect1d(before.mode_ids, after.mode_ids, return_indices=True)
        for forecast, kept in ((before, rows), (after, other_rows)):
            lacking = np.delete(forecast.weights, kept)
            difference.weight = max(difference.weight, *lacking.tolist(), 0.0)
        if before.samples.shape == after.samples.shape:
            _add_distance(difference, before.samples - after.samples)
    else:
        rows, other_rows = np.array([before.most_likely_mode]), np.array([after.most_likely_mode])
    if not len(rows):
        return
    _add_distance(difference, before.means[rows, :steps] - after.means[other_rows, :steps])
    weights = np.abs(before.weights[rows] - after.weights[other_rows])
    difference.weight = max(difference.weight, float(weights.max()))
    sigmas = np.abs(_sigmas(before)[rows, :steps] - _sigmas(after)[other_rows, :steps])
    difference.sigma_m = max(difference.sigma_m, float(sigmas.max(initial=0.0)))


def _add_distance(difference: Difference, apart: _Floats) -> None:
    distance = float(np.hypot(apart[..., 0], apart[..., 1]).max(initial=0.0))
    difference.position_m = max(difference.position_m, distance)


def _sigmas(forecast: Forecast) -> _Floats:
    """Return the standard deviations along x and y: [K, T, 2], m."""
    sigmas: _Floats = np.sqrt(np.diagonal(forecast.covariances, axis1=2, axis2=3))
    return sigmas


def _status(forecast: Forecast) -> str:
    return f"{forecast.status}" if forecast.status is Status.OK else f"{forecast.status} ({forecast.detail})"
