"""Settings: what goes before what, and what is refused."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr

from service.settings import SettingsError, load, split_address, split_shadow


@pytest.fixture(autouse=True)
def clean(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FORECAST_CONFIG", raising=False)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    file = tmp_path / "server.toml"
    file.write_text('http = "0.0.0.0:1"\ngrpc = "0.0.0.0:2"\nlog_level = "debug"\napi_tokens = ["a", "b"]\n')
    return file


def test_defaults() -> None:
    settings = load()
    assert (settings.http, settings.grpc, settings.store) == ("127.0.0.1:8080", "127.0.0.1:50051", "memory")
    assert settings.default_model is None
    assert settings.api_tokens == ()


def test_flags_then_environment_then_file(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORECAST_GRPC", "0.0.0.0:3")
    monkeypatch.setenv("FORECAST_LOG_LEVEL", "WARNING")
    settings = load(config, log_level="error", http=None)
    assert (settings.http, settings.grpc, settings.log_level) == ("0.0.0.0:1", "0.0.0.0:3", "error")


def test_file_from_the_environment(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORECAST_CONFIG", str(config))
    assert load().http == "0.0.0.0:1"


def test_tokens_are_read_and_not_shown(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert [token.get_secret_value() for token in load(config).api_tokens] == ["a", "b"]
    monkeypatch.setenv("FORECAST_API_TOKENS", "s3cret, other,")
    settings = load()
    assert [token.get_secret_value() for token in settings.api_tokens] == ["s3cret", "other"]
    assert "s3cret" not in repr(settings)


@pytest.mark.parametrize("value", ["", ",", " ", " , ,"])
def test_tokens_that_are_set_but_empty_let_nobody_in(value: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORECAST_API_TOKENS", value)
    with pytest.raises(SettingsError, match="api_tokens: is set but names no token"):
        load()


@pytest.mark.parametrize(
    "line", ['api_tokens = ""', 'api_tokens = [""]', 'api_tokens = ["s3cret", " "]', "api_tokens = [7]"]
)
def test_tokens_of_a_file_that_are_empty(line: str, tmp_path: Path) -> None:
    file = tmp_path / "server.toml"
    file.write_text(line + "\n")
    with pytest.raises(SettingsError, match="api_tokens") as caught:
        load(file)
    assert "s3cret" not in str(caught.value)


def test_tokens_of_a_file_are_stripped(tmp_path: Path) -> None:
    file = tmp_path / "server.toml"
    file.write_text('api_tokens = [" a", "b\\n"]\n')
    assert [token.get_secret_value() for token in load(file).api_tokens] == ["a", "b"]
    assert load(api_tokens=(SecretStr(" c "),)).api_tokens == (SecretStr("c"),)


def test_variables_that_set_nothing_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORECAST_MAX_AGENT", "3")
    with pytest.raises(SettingsError, match=r"FORECAST_MAX_AGENT: .* nearest is FORECAST_MAX_AGENTS"):
        load()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"store": "memcached://localhost"}, "store: is no URL of a Redis"),
        ({"http": "8080"}, 'http: "8080" is not HOST:PORT'),
        ({"grpc": "host:99999"}, "grpc: .* is not HOST:PORT"),
        ({"max_agents": 0}, "max_agents: "),
        ({"log_level": "loud"}, "log_level: "),
        ({"max_queue_agents": 10}, "max_queue_agents must be at least max_agents"),
        ({"colour": "red"}, "colour: "),
    ],
)
def test_refused(flags: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        load(**flags)


def test_bad_files(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no such configuration file"):
        load(tmp_path / "missing.toml")
    (tmp_path / "typo.toml").write_text('htpp = "127.0.0.1:1"\n')
    with pytest.raises(SettingsError) as caught:
        load(tmp_path / "typo.toml")
    assert str(caught.value) == f"{tmp_path}/typo.toml: htpp: there is no such setting; the nearest is http"
    (tmp_path / "broken.toml").write_text("http = \n")
    with pytest.raises(SettingsError, match=r"broken\.toml"):
        load(tmp_path / "broken.toml")


def test_errors_name_the_place_of_the_value(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "server.toml"
    file.write_text("max_agents = 0\n[serve]\nhttp = 1\n")
    with pytest.raises(SettingsError) as caught:
        load(file)
    agents, table = str(caught.value).split("; ", 1)
    assert agents == f"{file}: max_agents: Input should be greater than or equal to 1"
    assert table.startswith(f"{file}: serve: there is no such setting")
    file.write_text("max_agents = 7\n")
    monkeypatch.setenv("FORECAST_MAX_AGENTS", "many")
    with pytest.raises(SettingsError, match=r"^max_agents: .* \(in the variable FORECAST_MAX_AGENTS\)$"):
        load(file)
    with pytest.raises(SettingsError, match=r"^max_agents: [^(]*$"):
        load(file, max_agents=0)


def test_default_models_of_callers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORECAST_DEFAULT_MODELS", "truck = cab@2.1.0, lab=kalman,")
    assert load().default_models == {"truck": "cab@2.1.0", "lab": "kalman"}
    monkeypatch.setenv("FORECAST_DEFAULT_MODELS", "truck")
    with pytest.raises(SettingsError, match='default_models: "truck" is not key-name=model'):
        load()
    monkeypatch.delenv("FORECAST_DEFAULT_MODELS")
    file = tmp_path / "server.toml"
    file.write_text('[default_models]\ntruck = "cab"\n')
    assert load(file).default_models == {"truck": "cab"}


def test_shadow() -> None:
    assert load(shadow="cab@3.0.0:0.1").shadow == "cab@3.0.0:0.1"
    assert split_shadow("cab@3.0.0:0.1") == ("cab@3.0.0", 0.1)
    for wrong in ("", "cab", "cab:", ":0.5", "cab:0", "cab:1.1", "cab:nan", "cab:half"):
        with pytest.raises(SettingsError, match=r"shadow: .* is not name@version:share"):
            load(shadow=wrong)


def test_addresses() -> None:
    assert split_address("localhost:80") == ("localhost", 80)
    assert split_address("[::1]:0") == ("::1", 0)
    for wrong in ("", "localhost", ":80", "a:b", "a:-1"):
        with pytest.raises(ValueError, match="HOST:PORT"):
            split_address(wrong)
