"""Forecasts as a table."""

import io
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from cab.forecast.v1.consistency_service_pb2 import (
    TRACKING_STATUS_NEW,
    TRACKING_STATUS_RESET,
    TRACKING_STATUS_UNAVAILABLE,
)
from cab.forecast.v1.model_service_pb2 import ModelReference
from cab.forecast.v1.prediction_service_pb2 import (
    FORECAST_STATUS_FALLBACK,
    INPUT_WARNING_CODE_OFF_MAP,
    PredictRequest,
    PredictResponse,
)
from cab_forecast import agent, predict_request
from cab_forecast.show import print_forecasts
from tests.cab_forecast.answers import answer


def shown(response: PredictResponse, request: PredictRequest | None = None, width: int | None = None) -> str:
    """Return the printed text; with a width, as on a terminal."""
    file = io.StringIO()
    print_forecasts(
        response, request, Console(file=file, width=width, force_terminal=width is not None, no_color=True)
    )
    return file.getvalue()


def scene() -> PredictRequest:
    """Return a request of eleven agents that go straight on."""
    times = np.arange(-20, 1) / 10
    starts = {
        "car-straight": (7.0, -5.25, 10.0),
        "truck-behind": (-21.0, -5.25, 8.5),
        "car-parked": (34.0, -8.25, 0.0),
    }
    starts |= {f"walker-{number}": (3.0 * number, 12.0, 1.2) for number in range(8)}
    return predict_request(
        1.7e9,
        [
            agent(
                name,
                "pedestrian" if name.startswith("walker") else "vehicle",
                1.7e9 + times,
                np.stack([x + speed * times, np.full(21, y)], axis=-1),
                headings=np.zeros(21),
                velocities=np.tile([speed, 0.0], (21, 1)),
            )
            for name, (x, y, speed) in starts.items()
        ],
    )


def test_says_everything() -> None:
    request = scene()
    response = answer(request)
    response.forecasts[1].status = FORECAST_STATUS_FALLBACK
    response.forecasts[1].detail = "[this] type is not known"
    response.forecasts[1].model.CopyFrom(ModelReference(name="kalman", version="2.0.0"))
    request.agents.add(id="[bad]").states.add(time=request.time, x=0, y=0)
    response.forecasts.append(answer(request).forecasts[-1])
    text = shown(response, request)
    assert "in 1 s" in text
    assert "in 3 s" in text
    lines = text.splitlines()
    row = next(number for number, line in enumerate(lines) if line.startswith("car-straight"))
    assert [" ".join(line.split()) for line in lines[row : row + 4]] == [
        "car-straight vehicle OK 55 % straight on 10.0, +0.0 30.0, +0.0 60.0, +0.0 4.9 × 1.9",
        "20 % bears left 41° 10.0, +0.9 29.2, +6.2 54.3, +22.3 4.9 × 1.9",
        "15 % bears right 41° 10.0, -0.9 29.2, -6.2 54.3, -22.3 4.9 × 1.9",
        "10 % other modes",
    ]
    assert "truck-behind: FALLBACK by kalman@2.0.0: [this] type is not known" in text
    assert "[bad]: INVALID: agents[0].states: one state is too few" in text
    assert "model fan@1.0.0 · protocol causal · queue 0.2 ms · inference 3.1 ms · batch of 11 agents" in text
    assert "warning: figures of a fan, not of a model" in text


def test_without_the_request_positions_are_those_of_the_ground_frame() -> None:
    text = shown(answer(scene()))
    assert "vehicle" not in text
    assert "straight on" not in text
    (straight,) = (line for line in text.splitlines() if line.startswith("car-straight"))
    assert " ".join(straight.split()) == "car-straight OK 55 % 17.0, -5.2 37.0, -5.2 67.0, -5.2 4.9 × 1.9"
    assert sum("10 %" in line and "other modes" in line for line in text.splitlines()) == 11


def test_an_agent_that_looks_nowhere_has_no_ahead() -> None:
    request = scene()
    parked = next(agent for agent in request.agents if agent.id == "car-parked")
    for state in parked.states:
        state.ClearField("heading")
    (line,) = (line for line in shown(answer(request), request).splitlines() if line.startswith("car-parked"))
    assert " ".join(line.split()) == (
        "car-parked vehicle OK 55 % heading unknown: x, y 34.0, -8.2 34.0, -8.2 34.0, -8.2 0.1 × 0.1"
    )


@settings(deadline=None)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=6).filter(lambda drawn: sum(drawn) > 0.01), st.data())
def test_percents_sum_to_a_hundred(drawn: list[float], data: st.DataObject) -> None:
    """The sum does not depend on the share of returned modes."""
    request = scene()
    del request.agents[1:]
    response = answer(request)
    (forecast,) = response.forecasts
    weights = np.array(drawn) / sum(drawn)
    returned = data.draw(st.integers(1, len(weights)))
    forecast.weights[:] = weights[:returned].tolist()
    forecast.remaining_weight = float(weights[returned:].sum())
    forecast.mode_ids[:] = range(returned)
    forecast.most_likely_mode = int(weights[:returned].argmax())
    forecast.means[:] = [*forecast.means[:24]] * returned
    forecast.covariances[:] = [*forecast.covariances[:36]] * returned
    percents = [int(found) for found in re.findall(r"(\d+) %", shown(response, request))]
    assert sum(percents) == 100
    assert len(percents) <= 4
    assert abs(percents[0] - 100 * weights[:returned].max()) < 1


@pytest.mark.parametrize(("width", "first"), [(120, True), (92, False), (20, False)])
def test_a_narrow_terminal_gets_fewer_horizons(width: int, first: bool) -> None:
    request = scene()
    text = shown(answer(request), request, width)
    assert ("in 1 s" in text) == first
    if width > 20:
        assert "in 6 s" in text
        assert all(len(line) <= width for line in text.splitlines() if line.startswith(("car", "cyc")))


def test_a_short_horizon() -> None:
    request = scene()
    request.options.horizon = 2.0
    text = shown(answer(request), request)
    assert "in 1 s" in text
    assert "in 2 s" in text
    assert "in 3 s" not in text


def test_what_became_of_the_memory() -> None:
    response = answer(scene())
    assert "memory" not in shown(response)
    response.tracking = TRACKING_STATUS_NEW
    response.timing.tracking = 0.0015
    assert shown(response).rstrip().splitlines()[-2].endswith("track memory new, 1.5 ms")
    response.tracking = TRACKING_STATUS_UNAVAILABLE
    assert "warning: the track memory did not respond in time" in shown(response)
    response.tracking = TRACKING_STATUS_RESET
    response.forecasts[1].tracking = TRACKING_STATUS_RESET
    text = shown(response)
    assert "warning: the server no longer has the tracks of the scene" in text
    assert "start anew: truck-behind" in text


def test_warnings_of_the_input_are_shown_once() -> None:
    response = answer(scene())
    for forecast in response.forecasts[:2]:
        forecast.warnings.add(
            code=INPUT_WARNING_CODE_OFF_MAP, detail="90 % of the paths", field="scene_raster"
        )
    names = ", ".join(forecast.agent_id for forecast in response.forecasts[:2])
    assert shown(response).count(f"warning: OFF_MAP: {names}: 90 % of the paths") == 1


def test_an_empty_answer() -> None:
    assert "protocol unspecified" in shown(PredictResponse())
