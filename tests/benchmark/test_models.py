"""Selection of the models of an endpoint."""

import pytest

from benchmark.errors import BenchmarkError
from benchmark.models import oldest_first, select
from cab.forecast.v1.model_service_pb2 import (
    AGENT_TYPE_PEDESTRIAN,
    AGENT_TYPE_VEHICLE,
    INPUT_PROTOCOL_CAUSAL,
    INPUT_PROTOCOL_PAPER,
    Model,
)
from model.forecaster import Protocol


def model(name: str, version: str = "1.0.0", paper: bool = False) -> Model:
    """Return a model as an endpoint lists it."""
    protocol = INPUT_PROTOCOL_PAPER if paper else INPUT_PROTOCOL_CAUSAL
    return Model(name=name, version=version, protocol=protocol, agent_types=[AGENT_TYPE_VEHICLE], horizon=6.0)


LISTED = [
    model("cab"),
    model("cab", "1.0.0+paper", paper=True),
    model("cab", "1.1.0"),
    model("constant-velocity-yaw"),
    model("kalman"),
    model("trajectron", paper=True),
]


def test_all_of_the_protocol_and_the_baselines() -> None:
    causal = ["cab@1.0.0", "cab@1.1.0", "constant-velocity-yaw@1.0.0", "kalman@1.0.0"]
    assert list(select(LISTED, Protocol.CAUSAL)) == causal
    paper = ["cab@1.0.0+paper", "constant-velocity-yaw@1.0.0", "kalman@1.0.0", "trajectron@1.0.0"]
    assert list(select(LISTED, Protocol.PAPER)) == paper


def test_a_name_is_its_newest_version_of_the_protocol() -> None:
    assert list(select(LISTED, Protocol.CAUSAL, ["kalman", "cab"])) == ["kalman@1.0.0", "cab@1.1.0"]
    assert list(select(LISTED, Protocol.PAPER, ["cab"])) == ["cab@1.0.0+paper"]


def test_a_named_model_is_selected_whatever_its_protocol() -> None:
    assert list(select(LISTED, Protocol.CAUSAL, ["trajectron"])) == ["trajectron@1.0.0"]
    assert list(select(LISTED, Protocol.PAPER, ["cab@1.0.0"])) == ["cab@1.0.0"]


def test_a_missing_model_is_named() -> None:
    with pytest.raises(BenchmarkError, match=r"no model 'fan'; it has cab@1\.0\.0, cab@1\.0\.0"):
        select(LISTED, Protocol.CAUSAL, ["fan"])
    with pytest.raises(BenchmarkError, match="the endpoint has no model of the causal protocol"):
        select([model("trajectron", paper=True)], Protocol.CAUSAL)


def test_a_model_without_vehicles_is_selected_only_if_named() -> None:
    walker = model("walker")
    walker.ClearField("agent_types")
    walker.agent_types.append(AGENT_TYPE_PEDESTRIAN)
    assert "walker@1.0.0" not in select([*LISTED, walker], Protocol.CAUSAL)
    assert list(select([*LISTED, walker], Protocol.CAUSAL, ["walker"])) == ["walker@1.0.0"]


def test_a_short_horizon_is_refused_before_any_request() -> None:
    short = model("short")
    short.horizon = 4.0
    with pytest.raises(BenchmarkError, match=r"short@1\.0\.0: forecasts less than 6 s"):
        select([*LISTED, short], Protocol.CAUSAL)
    assert "cab@1.1.0" in select([*LISTED, short], Protocol.CAUSAL, ["cab"])


def test_versions_are_numbers_and_names_are_names() -> None:
    keys = ["a-b@1.0.0", "a@10.0.0", "a@9.0.0", "a@strange"]
    assert oldest_first(keys) == ["a@strange", "a@9.0.0", "a@10.0.0", "a-b@1.0.0"]
    newest = [model("cab", version) for version in ("1.10.0", "1.9.0")]
    assert list(select(newest, Protocol.CAUSAL, ["cab"])) == ["cab@1.10.0"]
