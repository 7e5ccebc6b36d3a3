"""The catalog: which model is the default, which one stands in, and what the contract says of them."""

import pytest
from structlog.testing import capture_logs

from cab.forecast.v1 import model_service_pb2 as pb
from model.forecaster import Protocol
from model.scenes.scene import AgentType
from service.errors import UnknownModel
from service.predict.catalog import PROTOCOLS, TYPE_NUMBERS, build_catalog, reference
from service.settings import FALLBACK_MODEL, SettingsError
from tests.service.fakes import FakeForecaster, registry


@pytest.mark.parametrize(
    ("names", "configured", "default"),
    [(("cab", "fake"), None, "cab"), (("fake",), None, "kalman"), (("cab", "fake"), "fake", "fake")],
)
def test_default(names: tuple[str, ...], configured: str | None, default: str) -> None:
    with capture_logs() as logs:
        catalog = build_catalog(registry(*map(FakeForecaster, names)), configured)
    assert catalog.default.info.name == default
    assert catalog.get("") is catalog.default
    assert catalog.fallback.info.name == FALLBACK_MODEL
    assert [entry["name"] for entry in logs] == [default]


def test_a_default_that_is_not_loaded_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"default_model: .*'nobody'"):
        build_catalog(registry(), "nobody")


@pytest.mark.parametrize("steps", [13, 20])
def test_a_horizon_beyond_the_fallbacks_is_refused(steps: int) -> None:
    with pytest.raises(SettingsError, match="models: fake forecasts further"):
        build_catalog(registry(FakeForecaster(steps=steps)), None)


def test_models_by_name_and_version() -> None:
    old, new = FakeForecaster(version="1.0.0"), FakeForecaster(version="2.0.0")
    catalog = build_catalog(registry(old, new), "fake")
    assert catalog.get("fake") is catalog.get("fake@2.0.0") is new
    assert catalog.get("fake@1.0.0") is old
    for name in ("nobody", "fake@3.0.0"):
        with pytest.raises(UnknownModel, match=name):
            catalog.get(name)


def test_a_long_name_is_not_repeated_to_the_caller() -> None:
    catalog = build_catalog(registry(), None)
    with pytest.raises(UnknownModel) as caught:
        catalog.get("x" * 100_000)
    assert caught.value.detail == "no model has a name of 100000 characters"


def test_description() -> None:
    fake = FakeForecaster(modes=7, uses_map=True, protocol=Protocol.PAPER, history_frames=2, steps=8)
    catalog = build_catalog(registry(fake), "kalman")
    described = catalog.describe(fake.info)
    assert (described.name, described.version, described.is_default) == ("fake", "1.0.0", False)
    assert described.protocol == pb.INPUT_PROTOCOL_PAPER
    assert list(described.agent_types) == [pb.AGENT_TYPE_VEHICLE, pb.AGENT_TYPE_PEDESTRIAN]
    assert (described.horizon, described.step, described.history_frames) == (4.0, 0.5, 2)
    assert (described.modes, described.uses_map, described.uses_neighbors) == (7, True, False)
    assert (described.supports_blind, described.license) == (True, "Apache-2.0")
    assert dict(described.benchmark) == {"fde_ml_6s_m": 1.5}
    assert catalog.describe(catalog.default.info).is_default


def test_reference() -> None:
    expected = pb.ModelReference(name="fake", version="1.0.0", protocol=pb.INPUT_PROTOCOL_CAUSAL)
    assert reference(FakeForecaster().info) == expected


def test_every_protocol_and_type_has_a_number() -> None:
    assert set(PROTOCOLS) == set(Protocol)
    assert set(TYPE_NUMBERS) == set(AgentType)
