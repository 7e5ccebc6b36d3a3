"""``cab-forecast doctor``: what it finds, and its exit code."""

import json
import os
import socket
from pathlib import Path

import pytest
import trustme
from typer.testing import CliRunner

from cli.main import app
from loadtest.redis_servers import single
from tests.model.checkpoints import copy_bundled
from tests.service.certificates import write_certificate
from tests.service.tracking.store.stores import require_redis

SMALL = "trajectron-no-context"


@pytest.fixture(autouse=True)
def surroundings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder with one model, and free ports."""
    for name in list(os.environ):
        if name.startswith("FORECAST_"):
            monkeypatch.delenv(name)
    copy_bundled(tmp_path / "one", SMALL, "2.0.0")
    values = {"MODELS": str(tmp_path), "DEFAULT_MODEL": SMALL, "HTTP": "127.0.0.1:0", "GRPC": "127.0.0.1:0"}
    for name, value in values.items():
        monkeypatch.setenv(f"FORECAST_{name}", value)


def run(code: int) -> dict[str, list[tuple[str, str]]]:
    """Return level and text of each finding, by check."""
    result = CliRunner().invoke(app, ["doctor", "--json"])
    assert result.exit_code == code, result.output
    found: dict[str, list[tuple[str, str]]] = {}
    for one in json.loads(result.stdout):
        found.setdefault(one["check"], []).append((one["level"], one["text"]))
    return found


def test_all_is_well() -> None:
    found = run(0)
    checks = [
        "settings",
        "models",
        "default model",
        "store",
        "http",
        "grpc",
        "threads",
        "open files",
        "protection",
    ]
    assert list(found) == checks
    assert f"{SMALL}@2.0.0" in found["models"][0][1]
    plain = CliRunner().invoke(app, ["doctor"])
    assert plain.exit_code == 0
    assert plain.stdout.startswith("OK   settings: valid\nOK   models: ")


def test_settings_that_are_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORECAST_MAX_AGENT", "3")
    ((level, text),) = run(1)["settings"]
    assert (level, "nearest is FORECAST_MAX_AGENTS" in text) == ("FAIL", True)


def test_models_that_are_damaged_or_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy_bundled(tmp_path / "two", SMALL, "2.1.0")
    (tmp_path / "two" / "model.safetensors").write_bytes(b"")
    models = run(0)["models"]
    assert [level for level, _ in models] == ["OK", "WARN"]
    assert "two is refused" in models[1][1]
    monkeypatch.setenv("FORECAST_DEFAULT_MODEL", "nobody")
    assert run(1)["default model"][0][0] == "FAIL"


def test_surroundings_that_are_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        monkeypatch.setenv("FORECAST_HTTP", f"127.0.0.1:{port}")
        monkeypatch.setenv("FORECAST_GRPC", "0.0.0.0:0")
        monkeypatch.setenv("FORECAST_THREADS", "64")
        monkeypatch.setenv("FORECAST_MAX_CONCURRENT_CALLS", "100000000")
        with socket.socket() as closed:  # nobody listens there
            closed.bind(("127.0.0.1", 0))
            monkeypatch.setenv("FORECAST_STORE", f"redis://127.0.0.1:{closed.getsockname()[1]}")
            found = run(1)
    assert found["http"] == [("FAIL", f"cannot listen on 127.0.0.1:{port}: Address already in use")]
    assert found["store"][0][0] == "FAIL"
    assert "does not answer" in found["store"][0][1]
    assert found["threads"][0][0] == "WARN"
    [(level, text)] = found["protection"]
    assert level == "FAIL"
    assert "FORECAST_ALLOW_ANYONE" in text


def test_protection(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert run(0)["protection"] == [("OK", "only this machine can connect; no TLS")]
    monkeypatch.setenv("FORECAST_HTTP", "0.0.0.0:0")
    monkeypatch.setenv("FORECAST_ALLOW_ANYONE", "true")
    assert run(0)["protection"] == [("WARN", "everyone who reaches the ports is let in; no TLS")]
    monkeypatch.setenv("FORECAST_API_TOKENS", "token")
    assert run(0)["protection"] == [("WARN", "callers need a key; no TLS")]
    chain, key = write_certificate(trustme.CA(), tmp_path, "server")
    monkeypatch.setenv("FORECAST_TLS_CERTIFICATE", str(chain))
    monkeypatch.setenv("FORECAST_TLS_KEY", str(key))
    assert run(0)["protection"] == [("OK", "callers need a key; TLS")]
    key.write_text("")
    [(level, text)] = run(1)["protection"]
    assert level == "FAIL"
    assert text.startswith("tls: ")


def test_a_redis_that_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    require_redis()
    with single() as server:
        monkeypatch.setenv("FORECAST_STORE", server.url)
        ((level, text),) = run(0)["store"]
    assert level in {"OK", "WARN"}  # a busy machine may be slow
    assert text.startswith("Redis ")
