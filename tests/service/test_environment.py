"""Environment variables that set nothing."""

import pytest

from service.environment import unknown_variable

SETTINGS = ["max_agents", "max_states", "http", "log_json"]


@pytest.mark.parametrize(
    "name",
    [
        "FORECAST_MAX_AGENTS",
        "forecast_max_agents",
        "FORECAST_CONFIG",
        "PATH",
        "CAB_FORECAST_TOKEN",
        "FORECASTER",
        "FORECAST_SERVICE_HOST",
        "FORECAST_SERVICE_PORT",
        "FORECAST_SERVICE_PORT_GRPC",
        "FORECAST_GATEWAY_SERVICE_HOST",
        "FORECAST_PORT_8080_TCP",
        "FORECAST_PORT_8080_TCP_ADDR",
    ],
)
def test_known(name: str) -> None:
    assert unknown_variable({name: "1"}, SETTINGS) is None


def test_an_address_from_kubernetes_is_no_setting() -> None:
    assert unknown_variable({"FORECAST_PORT": "tcp://10.0.0.7:8080"}, SETTINGS) is None
    assert unknown_variable({"FORECAST_PORT": "8080"}, SETTINGS) is not None


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("FORECAST_MAX_AGENT", "FORECAST_MAX_AGENTS"),
        ("forecast_htpp", "FORECAST_HTTP"),
        ("FORECAST_LOGJSON", "FORECAST_LOG_JSON"),
        ("FORECAST_CONFIGURATION", "FORECAST_CONFIG"),
        ("FORECAST_", "FORECAST_HTTP"),
    ],
)
def test_unknown(name: str, nearest: str) -> None:
    told = unknown_variable({"PATH": "", name: "secret"}, SETTINGS)
    assert told == f"{name}: there is no such setting; the nearest is {nearest}"
