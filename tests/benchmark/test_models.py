"""Which models of an endpoint are judged."""

import pytest

from benchmark import BenchmarkError
from benchmark.models import choose
from cab.forecast.v1.model_service_pb2 import INPUT_PROTOCOL_CAUSAL, INPUT_PROTOCOL_PAPER, Model
from model.forecaster import Protocol


def model(name: str, version: str = "1.0.0", paper: bool = False) -> Model:
    """As an endpoint lists it."""
    protocol = INPUT_PROTOCOL_PAPER if paper else INPUT_PROTOCOL_CAUSAL
    return Model(name=name, version=version, protocol=protocol, trained_on="something")


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
    assert list(choose(LISTED, Protocol.CAUSAL)) == causal
    paper = ["cab@1.0.0+paper", "constant-velocity-yaw@1.0.0", "kalman@1.0.0", "trajectron@1.0.0"]
    assert list(choose(LISTED, Protocol.PAPER)) == paper


def test_a_name_is_its_newest_version_of_the_protocol() -> None:
    assert list(choose(LISTED, Protocol.CAUSAL, ["kalman", "cab"])) == ["kalman@1.0.0", "cab@1.1.0"]
    assert list(choose(LISTED, Protocol.PAPER, ["cab"])) == ["cab@1.0.0+paper"]


def test_who_is_named_is_judged_whatever_its_protocol() -> None:
    assert list(choose(LISTED, Protocol.CAUSAL, ["trajectron"])) == ["trajectron@1.0.0"]
    assert list(choose(LISTED, Protocol.PAPER, ["cab@1.0.0"])) == ["cab@1.0.0"]


def test_who_is_not_there_is_said() -> None:
    with pytest.raises(BenchmarkError, match=r"no model 'fan'; it has cab@1\.0\.0, cab@1\.0\.0"):
        choose(LISTED, Protocol.CAUSAL, ["fan"])
    with pytest.raises(BenchmarkError, match="lists no model of the causal protocol"):
        choose([model("trajectron", paper=True)], Protocol.CAUSAL)
