"""Forecasts as arrays."""

import numpy as np
import pytest

from cab.forecast.v1.consistency_service_pb2 import TRACKING_STATUS_RESET, TRACKING_STATUS_UNAVAILABLE
from cab.forecast.v1.prediction_service_pb2 import (
    FORECAST_STATUS_INVALID,
    INPUT_WARNING_CODE_TIME_UNIT,
    PredictResponse,
)
from cab_forecast import InputWarning, Status, Tracking, demo_request, forecasts, tracking
from tests.cab_forecast.answers import MODEL, TURN_RATES, WEIGHTS, answer


@pytest.fixture
def response() -> PredictResponse:
    request = demo_request()
    request.options.samples = 3
    request.agents.add(id="bad").states.add(time=request.time, x=0, y=0)
    return answer(request)


def test_shapes_and_values(response: PredictResponse) -> None:
    views = forecasts(response)
    assert list(views) == [entry.agent_id for entry in response.forecasts]
    entry, K, T = response.forecasts[2], len(TURN_RATES), 12
    view = views[entry.agent_id]
    assert (view.status, view.model, view.history_frames) == (Status.OK, MODEL, 5)
    assert view.means.shape == (K, T, 2)
    assert view.covariances.shape == (K, T, 2, 2)
    assert view.samples.shape == (3, T, 2)
    np.testing.assert_array_equal(view.weights, WEIGHTS)
    np.testing.assert_allclose(view.times - response.time, 0.5 * np.arange(1, T + 1))
    k, t = 3, 7
    assert view.means[k, t].tolist() == entry.means[(k * T + t) * 2 :][:2]
    xx, xy, yy = entry.covariances[(k * T + t) * 3 :][:3]
    assert view.covariances[k, t].tolist() == [[xx, xy], [xy, yy]]
    assert view.samples[2, t].tolist() == entry.samples[(2 * T + t) * 2 :][:2]
    np.testing.assert_array_equal(view.most_likely, view.means[0])
    assert view.ranked_modes.tolist() == [0, 1, 2, 3, 4]


def test_an_invalid_agent_has_no_forecast(response: PredictResponse) -> None:
    view = forecasts(response)["bad"]
    assert view.status is Status.INVALID
    assert view.field == "agents[0].states"
    assert view.means.shape == (0, 12, 2)
    assert view.covariances.shape == (0, 12, 2, 2)
    with pytest.raises(ValueError, match="'bad' has no forecast: INVALID, one state is too few"):
        _ = view.most_likely


def test_a_second_report_on_an_id_does_not_hide_the_first(response: PredictResponse) -> None:
    response.forecasts.add(agent_id="cyclist-10", status=FORECAST_STATUS_INVALID)
    assert forecasts(response)["cyclist-10"].status is Status.OK


def test_a_status_of_the_future(response: PredictResponse) -> None:
    response.forecasts[0].status = 99  # type: ignore[assignment]
    assert forecasts(response)["vehicle-3"].status is Status.UNSPECIFIED


def test_warnings_of_the_input(response: PredictResponse) -> None:
    assert forecasts(response)["vehicle-3"].warnings == ()
    entry = response.forecasts[0]
    entry.warnings.add(code=INPUT_WARNING_CODE_TIME_UNIT, detail="in ns?", field="agents[0].states[1].time")
    entry.warnings.add(code=99)
    first, unknown = forecasts(response)["vehicle-3"].warnings
    assert first == InputWarning("TIME_UNIT", "in ns?", "agents[0].states[1].time")
    assert unknown.code == "UNSPECIFIED"


def test_tracking_and_consistency(response: PredictResponse) -> None:
    entry = response.forecasts[0]
    view = forecasts(response)["vehicle-3"]
    assert (view.tracking, view.consistency) == (Tracking.UNSPECIFIED, None)
    assert tracking(response) is Tracking.UNSPECIFIED
    response.tracking = TRACKING_STATUS_UNAVAILABLE
    entry.tracking = TRACKING_STATUS_RESET
    entry.consistency.time = 2.5
    view = forecasts(response)["vehicle-3"]
    assert view.tracking is Tracking.RESET
    assert view.consistency is not None
    assert view.consistency.time == 2.5
    assert tracking(response) is Tracking.UNAVAILABLE
    response.tracking = 99  # type: ignore[assignment]
    assert tracking(response) is Tracking.UNSPECIFIED


def test_no_agents() -> None:
    assert forecasts(PredictResponse()) == {}


@pytest.mark.parametrize("name", ["means", "covariances", "mode_ids", "samples"])
def test_contradicting_sizes_are_refused(response: PredictResponse, name: str) -> None:
    getattr(response.forecasts[0], name).append(1)
    with pytest.raises(ValueError, match="'vehicle-3'"):
        forecasts(response)


def test_a_most_likely_mode_that_is_not_there(response: PredictResponse) -> None:
    response.forecasts[0].most_likely_mode = 5
    with pytest.raises(ValueError, match="no mode 5 among 5"):
        forecasts(response)
