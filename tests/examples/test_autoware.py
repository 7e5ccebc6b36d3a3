"""Autoware's messages, to the contract and back."""

import json
import math
import struct
from typing import Any

import pytest
from google.protobuf import json_format

from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from examples.python import autoware
from tests.docs.pages import ROOT

Fields = dict[str, Any]
CAR, WALKER, BICYCLE = 0, 1, 2
STEPS = 12


@pytest.fixture
def message() -> Fields:
    """Return the last of the bundled messages: a car, a pedestrian and a bicycle."""
    text = (ROOT / "examples/python/tracked_objects.json").read_text(encoding="utf-8")
    last: Fields = json.loads(text)[-1]
    return last


def response_of(message: Fields, *modes: tuple[float, tuple[float, float]]) -> Fields:
    """Return a response in which every object has modes of a weight and a constant velocity, m/s."""
    forecasts = []
    for one in message["objects"]:
        at = one["kinematics"]["pose_with_covariance"]["pose"]["position"]
        means = [
            value
            for _, (vx, vy) in modes
            for step in range(1, STEPS + 1)
            for value in (at["x"] + vx * step / 2, at["y"] + vy * step / 2)
        ]
        weights = [weight for weight, _ in modes]
        forecasts.append({"agent_id": autoware.agent_id(one), "weights": weights, "means": means})
    return {"forecasts": forecasts, "steps": STEPS, "step": 0.5}


def turned(one: Fields, yaw: float) -> Fields:
    one["kinematics"]["pose_with_covariance"]["pose"]["orientation"] = autoware.to_quaternion(yaw)
    return one


def yaws(path: Fields) -> list[float]:
    return [autoware.to_yaw(one["orientation"]) for one in path["path"]]


def as_float32(value: float) -> float:
    number: float = struct.unpack("f", struct.pack("f", value))[0]
    return number


def test_a_request_is_one_of_the_contract(message: Fields) -> None:
    request = json_format.ParseDict(autoware.predict_request(message, "scene"), PredictRequest())
    assert request.time == 1_700_000_002
    assert [agent.id for agent in request.agents] == ["11" * 16, "22" * 16, "33" * 16]
    assert [agent.type for agent in request.agents] == [1, 2, 3]
    [state] = request.agents[CAR].states
    assert (state.x, state.y) == (3700.0, 73716.0)
    assert state.heading == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5, math.pi])
def test_twists_are_turned_to_the_ground_frame(message: Fields, yaw: float) -> None:
    car = turned(message["objects"][CAR], yaw)
    car["kinematics"]["twist_with_covariance"]["twist"]["linear"] = {"x": 8.0, "y": 0.5, "z": 0.0}
    state = autoware.state(car, 1.0)
    assert math.hypot(state["velocity_x"], state["velocity_y"]) == pytest.approx(math.hypot(8, 0.5))
    course = math.atan2(state["velocity_y"], state["velocity_x"]) - math.atan2(0.5, 8)
    assert math.cos(course - yaw) == pytest.approx(1)
    assert math.cos(state["heading"] - yaw) == pytest.approx(1)


def test_what_is_not_known_is_not_sent(message: Fields) -> None:
    bicycle = message["objects"][BICYCLE]  # the sign of its orientation is unknown
    state = autoware.state(bicycle, 1.0)
    assert "heading" not in state
    assert state["velocity_y"] == pytest.approx(-4)
    bicycle["kinematics"]["orientation_availability"] = autoware.ORIENTATION_UNAVAILABLE
    assert set(autoware.state(bicycle, 1.0)) == {"time", "x", "y"}


@pytest.mark.parametrize(
    ("labels", "kind"),
    [
        ([(1, 0.4), (2, 0.6)], "VEHICLE"),
        ([(5, 1.0)], "CYCLIST"),
        ([(6, 0.5), (7, 0.6)], "PEDESTRIAN"),
        ([(8, 1.0)], "UNKNOWN"),
        ([], "UNKNOWN"),
    ],
)
def test_the_most_probable_label_is_the_type(labels: list[tuple[int, float]], kind: str) -> None:
    classification = [{"label": label, "probability": probability} for label, probability in labels]
    assert autoware.agent_type({"classification": classification}) == f"AGENT_TYPE_{kind}"


def test_another_frame_is_refused(message: Fields) -> None:
    message["header"]["frame_id"] = "base_link"
    with pytest.raises(ValueError, match='must be in the frame "map", not "base_link"'):
        autoware.predict_request(message, "scene")


def test_there_and_back_the_forecast_is_the_same(message: Fields) -> None:
    response = response_of(message, (0.25, (0.0, 8.0)), (0.625, (2.0, 7.0)), (0.125, (0.0, 0.0)))
    told = autoware.predicted_objects(response, message)
    for one, sent in zip(told["objects"], response["forecasts"], strict=True):
        for path in one["kinematics"]["predicted_paths"]:
            path["confidence"] = as_float32(path["confidence"])
        back = autoware.forecast(one)
        assert back["agent_id"] == sent["agent_id"]
        assert back["weights"] == pytest.approx([0.625, 0.25, 0.125], abs=1e-6)
        mode = 2 * STEPS
        means = sent["means"]
        assert back["means"] == means[mode : 2 * mode] + means[:mode] + means[2 * mode :]
        assert [(path.step, len(path.positions)) for path in autoware.paths(one)] == [(0.5, STEPS + 1)] * 3
    again = autoware.predict_request(told, "scene")
    del message["objects"][BICYCLE], again["agents"][BICYCLE], told["objects"][BICYCLE]
    assert again["agents"] == autoware.predict_request(message, "scene")["agents"]
    assert [autoware.object_id(one["id"]) for one in again["agents"]] == [
        one["object_id"] for one in told["objects"]
    ]


def test_paths_begin_with_the_present_and_look_where_they_go(message: Fields) -> None:
    response = response_of(message, (0.75, (3.0, 3.0)), (0.25, (0.0, -1.0)))
    car, walker, _ = autoware.predicted_objects(response, message)["objects"]
    ahead, back = car["kinematics"]["predicted_paths"]
    pose = car["kinematics"]["initial_pose_with_covariance"]["pose"]
    assert ahead["path"][0] == back["path"][0] == pose
    assert ahead["time_step"] == {"sec": 0, "nanosec": 500_000_000}
    assert {one["position"]["z"] for one in ahead["path"]} == {19.4}
    assert [autoware.to_yaw(one["orientation"]) for one in ahead["path"][1:]] == pytest.approx(
        [math.pi / 4] * 12
    )
    # The car reverses, and keeps its front; the pedestrian turns around
    assert yaws(back) == pytest.approx([math.pi / 2] * (STEPS + 1))
    _, down = walker["kinematics"]["predicted_paths"]
    assert yaws(down)[1] == pytest.approx(-math.pi / 2)


def test_what_stands_keeps_its_direction(message: Fields) -> None:
    response = response_of(message, (1.0, (0.001, -0.001)))
    car = autoware.predicted_objects(response, message)["objects"][CAR]
    [path] = car["kinematics"]["predicted_paths"]
    assert yaws(path) == pytest.approx([math.pi / 2] * (STEPS + 1))


def test_an_object_without_a_forecast_stays(message: Fields) -> None:
    response = response_of(message, (1.0, (1.0, 1.0)))
    response["forecasts"][WALKER] = {"agent_id": "22" * 16, "status": "FORECAST_STATUS_INVALID"}
    told = autoware.predicted_objects(response, message)
    assert [len(one["kinematics"]["predicted_paths"]) for one in told["objects"]] == [1, 0, 1]
    assert autoware.forecast(told["objects"][WALKER])["weights"] == []


def test_too_many_paths_are_refused(message: Fields) -> None:
    response = response_of(message, *[(1 / 101, (1.0, 1.0))] * 101)
    with pytest.raises(ValueError, match="101 paths: ask for merged modes"):
        autoware.predicted_objects(response, message)


def test_paths_that_are_no_mixture_are_refused(message: Fields) -> None:
    response = response_of(message, (0.5, (0.0, 8.0)), (0.5, (2.0, 7.0)))
    car = autoware.predicted_objects(response, message)["objects"][CAR]
    first, second = car["kinematics"]["predicted_paths"]
    first["confidence"] = second["confidence"] = 0.0
    with pytest.raises(ValueError, match="all confidences"):
        autoware.forecast(car)
    first["path"].pop()
    with pytest.raises(ValueError, match="differ in length"):
        autoware.forecast(car)


@pytest.mark.parametrize("seconds", [0.0, 0.1, 0.5, 1.25])
def test_durations_and_stamps(seconds: float) -> None:
    assert autoware.from_stamp(autoware.to_duration(seconds)) == pytest.approx(seconds, abs=1e-9)
