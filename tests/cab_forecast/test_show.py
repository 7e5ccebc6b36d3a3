"""The table."""

import io

import pytest
from rich.console import Console

from cab.forecast.v1.consistency_service_pb2 import (
    TRACKING_STATUS_NEW,
    TRACKING_STATUS_RESET,
    TRACKING_STATUS_UNAVAILABLE,
)
from cab.forecast.v1.model_service_pb2 import ModelReference
from cab.forecast.v1.prediction_service_pb2 import FORECAST_STATUS_FALLBACK, PredictRequest, PredictResponse
from cab_forecast import demo_request
from cab_forecast.show import print_forecasts
from tests.cab_forecast.answers import answer


def shown(response: PredictResponse, request: PredictRequest | None = None, width: int | None = None) -> str:
    """What is printed; a width makes it a terminal's."""
    file = io.StringIO()
    print_forecasts(
        response, request, Console(file=file, width=width, force_terminal=width is not None, no_color=True)
    )
    return file.getvalue()


def test_says_everything() -> None:
    request = demo_request()
    response = answer(request)
    response.forecasts[1].status = FORECAST_STATUS_FALLBACK
    response.forecasts[1].detail = "[this] type is not known"
    response.forecasts[1].model.CopyFrom(ModelReference(name="kalman", version="2.0.0"))
    request.agents.add(id="[bad]").states.add(time=request.time, x=0, y=0)
    response.forecasts.append(answer(request).forecasts[-1])
    text = shown(response, request)
    assert "in 1 s" in text
    assert "in 3 s" in text
    straight = next(line for line in text.splitlines() if line.startswith("car-straight"))
    assert straight.split("  ")[0] == "car-straight"
    for part in ("vehicle", "OK", "0.55 of 5", "17.0, -5.2", "37.0, -5.2", "67.0, -5.2", "4.9 × 1.9"):
        assert part in straight
    assert "truck-behind: FALLBACK by kalman@2.0.0: [this] type is not known" in text
    assert "[bad]: INVALID: agents[0].states: one state is too few" in text
    assert "model fan@1.0.0 · protocol causal · queue 0.2 ms · inference 3.1 ms · batch of 11 agents" in text
    assert "warning: figures of a fan, not of a model" in text


def test_without_the_request_there_are_no_types() -> None:
    assert "vehicle" not in shown(answer(demo_request()))


@pytest.mark.parametrize(("width", "first"), [(120, True), (82, False), (20, False)])
def test_a_narrow_terminal_gets_fewer_horizons(width: int, first: bool) -> None:
    request = demo_request()
    text = shown(answer(request), request, width)
    assert ("in 1 s" in text) == first
    if width > 20:
        assert "in 6 s" in text
        assert all(len(line) <= width for line in text.splitlines() if line.startswith(("car", "cyc")))


def test_a_short_horizon() -> None:
    request = demo_request()
    request.options.horizon = 2.0
    text = shown(answer(request), request)
    assert "in 1 s" in text
    assert "in 2 s" in text
    assert "in 3 s" not in text


def test_what_became_of_the_memory() -> None:
    response = answer(demo_request())
    assert "memory" not in shown(response)
    response.tracking = TRACKING_STATUS_NEW
    response.timing.tracking = 0.0015
    assert shown(response).rstrip().splitlines()[-2].endswith("track memory new, 1.5 ms")
    response.tracking = TRACKING_STATUS_UNAVAILABLE
    assert "warning: the track memory did not answer in time" in shown(response)
    response.tracking = TRACKING_STATUS_RESET
    response.forecasts[1].tracking = TRACKING_STATUS_RESET
    text = shown(response)
    assert "warning: what the server remembered of the scene is gone" in text
    assert "begins anew: truck-behind" in text


def test_an_empty_answer() -> None:
    assert "protocol unspecified" in shown(PredictResponse())
