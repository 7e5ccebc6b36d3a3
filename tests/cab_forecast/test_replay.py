"""Differences between responses, and requests that do not rely on a server's memory."""

from collections.abc import Callable

import pytest

from cab.forecast.v1.prediction_service_pb2 import (
    FORECAST_STATUS_FALLBACK,
    HISTORY_SOURCE_REQUEST,
    AgentState,
    PredictResponse,
)
from cab.forecast.v1.recording_pb2 import RecalledHistory, RecordedCall
from cab_forecast import demo_request
from cab_forecast.replay import Difference, compare, replay_request
from tests.cab_forecast.answers import answer


@pytest.fixture
def response() -> PredictResponse:
    """Return a response to the demo."""
    request = demo_request()
    request.options.samples = 2
    return answer(request)


def changed(response: PredictResponse, change: Callable[[PredictResponse], object]) -> Difference:
    """Return the difference that a change makes."""
    other = PredictResponse()
    other.CopyFrom(response)
    change(other)
    return compare(response, other)


def _set(values: object, index: int, value: float) -> None:
    values[index] = value  # type: ignore[index]


def test_a_response_does_not_differ_from_itself(response: PredictResponse) -> None:
    difference = compare(response, response)
    assert difference == Difference(agents=len(response.forecasts))
    assert difference.within(0.0)


def test_each_number_counts(response: PredictResponse) -> None:
    first = response.forecasts[0]
    difference = changed(response, lambda other: _set(other.forecasts[0].means, 4, first.means[4] + 3.0))
    assert difference.position_m == pytest.approx(3.0)
    assert (difference.weight, difference.sigma_m) == (0.0, 0.0)
    difference = changed(response, lambda other: _set(other.forecasts[3].samples, 0, 1e3))
    assert difference.position_m > 100
    difference = changed(response, lambda other: _set(other.forecasts[1].weights, 1, 0.5))
    assert difference.weight == pytest.approx(0.5 - response.forecasts[1].weights[1])
    difference = changed(response, lambda other: _set(other.forecasts[0].covariances, 2, 49.0))
    assert difference.sigma_m == pytest.approx(7.0 - first.covariances[2] ** 0.5)
    assert not difference.within(1.0)
    assert difference.within(10.0)


def test_a_mode_that_is_missing_counts_with_its_weight(response: PredictResponse) -> None:
    def drop(other: PredictResponse) -> None:
        forecast = other.forecasts[0]
        del forecast.mode_ids[1], forecast.weights[1]
        steps = other.steps
        del forecast.means[2 * steps : 4 * steps], forecast.covariances[3 * steps : 6 * steps]

    difference = changed(response, drop)
    assert difference.weight == pytest.approx(response.forecasts[0].weights[1])
    assert difference.position_m == 0.0


def test_of_another_model_the_most_likely_mode_is_compared(response: PredictResponse) -> None:
    def rename(other: PredictResponse) -> None:
        for forecast in other.forecasts:
            forecast.model.name = "other"
            forecast.mode_ids[:] = [number + 5 for number in forecast.mode_ids]
            forecast.means[-1] += 100.0  # of the least likely mode

    assert changed(response, rename).within(0.0)


def test_agents_and_statuses_are_named(response: PredictResponse) -> None:
    first, second = response.forecasts[0].agent_id, response.forecasts[1].agent_id

    def change(other: PredictResponse) -> None:
        other.forecasts[0].status = FORECAST_STATUS_FALLBACK
        other.forecasts[0].detail = "why"
        other.forecasts[1].agent_id = "new"

    assert changed(response, change).others == [
        f"{first}: OK → FALLBACK (why)",
        f"{second}: not in the answer",
        "new: only in the answer",
    ]


def test_a_replayed_request_stands_alone(response: PredictResponse) -> None:
    request = demo_request()
    request.options.samples = 2
    response.seed = 77
    states = [AgentState(time=0.5 * step, x=float(step), y=0.0) for step in range(3)]
    recalled = RecalledHistory(agent_id=request.agents[1].id, states=states)
    call = RecordedCall(request=request, response=response, recalled=[recalled])
    sent = replay_request(call)
    assert (sent.scene_id, sent.options.seed, sent.model) == ("", 77, "fan@1.0.0")
    assert sent.options.history == HISTORY_SOURCE_REQUEST
    assert list(sent.agents[1].states) == states
    assert sent.agents[0] == request.agents[0]
    assert replay_request(call, "kalman").model == "kalman"
