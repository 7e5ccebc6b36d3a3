"""Authentication, changes of the file of keys, and the rule for servers without keys."""

import base64
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr
from structlog.testing import capture_logs

from cab.forecast.v1.routes import EXPLAIN, LIST_MODELS, PREDICT, RESET_SCENE, WATCH_SCENE, Route
from service.access.gate import TOKENS_NAME, Gate, require_protection
from service.access.key_file import Key, digest, write_keys
from service.access.scopes import Scope, scope_of
from service.errors import PermissionDenied, Unauthenticated
from service.settings import Settings, SettingsError
from service.telemetry.metrics import Metrics


def key(name: str, secret: str, scopes: Sequence[Scope] = (Scope.PREDICT,), limit: int | None = None) -> Key:
    return Key(name=name, sha256=digest(secret), scopes=tuple(scopes), concurrent_agents=limit)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "keys.json"
    write_keys(path, [key("one", "first"), key("two", "second", [Scope.READ, Scope.ADMIN])])
    return path


def test_every_method_has_a_scope() -> None:
    assert scope_of(PREDICT) is scope_of(EXPLAIN) is Scope.PREDICT
    assert scope_of(WATCH_SCENE) is Scope.READ
    assert scope_of(RESET_SCENE) is Scope.RESET
    assert scope_of(LIST_MODELS) is None
    new = Route(LIST_MODELS.service, "New", "GET", "/v1/new", LIST_MODELS.request, LIST_MODELS.response)
    assert scope_of(new) is Scope.ADMIN


def test_keys_and_tokens_are_told_apart(file: Path) -> None:
    gate = Gate(Settings(keys_file=file, api_tokens=(SecretStr("token"), SecretStr("other"))), Metrics())
    assert gate.closed
    assert gate.identify("Bearer first").name == "one"
    assert gate.identify("bearer  second ").name == "two"
    assert gate.identify("Bearer token").name == gate.identify("Bearer other").name == TOKENS_NAME
    for wrong in (None, "", "Bearer", "Bearer ", "Bearer third", "first", "Basic first", "Token first"):
        with pytest.raises(Unauthenticated):
            gate.identify(wrong)


def test_a_browser_sends_the_key_as_a_password(file: Path) -> None:
    gate = Gate(Settings(keys_file=file), Metrics())
    header = "Basic " + base64.b64encode(b"anyone:first").decode()
    assert gate.identify(header, basic=True).name == "one"
    with pytest.raises(Unauthenticated):
        gate.identify(header)
    for wrong in ("Basic !", "Basic /w==", "Basic " + base64.b64encode(b"first").decode()):
        with pytest.raises(Unauthenticated):
            gate.identify(wrong, basic=True)


def test_an_empty_key_is_none_even_if_a_file_has_its_hash(tmp_path: Path) -> None:
    file = tmp_path / "keys.json"
    write_keys(file, [key("nobody", "")])
    gate = Gate(Settings(keys_file=file), Metrics())
    with pytest.raises(Unauthenticated):
        gate.identify("Bearer ")


def test_scopes(file: Path) -> None:
    metrics = Metrics()
    gate = Gate(Settings(keys_file=file, api_tokens=(SecretStr("token"),)), metrics)
    one, two, token = (gate.identify(f"Bearer {secret}") for secret in ("first", "second", "token"))
    one.require(Scope.PREDICT)
    one.require(None)
    two.require(Scope.ADMIN)
    for scope in Scope:
        token.require(scope)
    for caller, scope in ((one, Scope.READ), (two, Scope.PREDICT)):
        with pytest.raises(PermissionDenied, match=f"lacks the scope {scope.value}"):
            caller.require(scope)
    labels = {"key": "one", "reason": "scope"}
    assert metrics.registry.get_sample_value("forecast_key_refused_total", labels) == 1


@pytest.mark.parametrize(("http", "admin"), [("127.0.0.1:0", True), ("0.0.0.0:0", False)])
def test_admin_calls_without_keys_are_for_this_machine_only(http: str, admin: bool) -> None:
    anyone = Gate(Settings(http=http, allow_anyone=True), Metrics()).identify(None)
    anyone.require(Scope.PREDICT)
    if admin:
        anyone.require(Scope.ADMIN)
    else:
        with pytest.raises(PermissionDenied):
            anyone.require(Scope.ADMIN)


async def test_a_changed_file_is_taken_over(file: Path) -> None:
    metrics = Metrics()
    gate = Gate(Settings(keys_file=file), metrics)
    assert not gate.refresh()
    before = gate.identify("Bearer first")
    with before.call():
        write_keys(file, [key("one", "first", [Scope.READ], limit=1), key("three", "third")])
        with capture_logs() as logs:
            assert gate.refresh()
            gate.apply()
            assert not gate.refresh()
        assert [(entry["event"], entry["log_level"]) for entry in logs] == [("keys reloaded", "warning")]
        after = gate.identify("Bearer first")
        after.require(Scope.READ)
        with pytest.raises(PermissionDenied):
            after.require(Scope.PREDICT)
        with pytest.raises(Exception, match="in progress"), after.call():  # what goes on counts
            pass
    assert gate.identify("Bearer third").name == "three"
    with pytest.raises(Unauthenticated):
        gate.identify("Bearer second")
    exported = metrics.render().decode()
    assert 'key="three"' in exported
    assert 'key="two"' not in exported


async def test_a_revoked_key_opens_no_stream(file: Path) -> None:
    gate = Gate(Settings(keys_file=file), Metrics())
    caller = gate.identify("Bearer second")
    async with caller.stream():
        pass
    write_keys(file, [])
    assert gate.refresh()
    gate.apply()
    with pytest.raises(Unauthenticated, match="revoked"):
        async with caller.stream():
            pass


@pytest.mark.parametrize("broken", ["", '{"keys": [', json.dumps({"keys": [{"name": "x"}]}), None])
def test_a_broken_file_changes_nothing_and_is_logged_once(file: Path, broken: str | None) -> None:
    gate = Gate(Settings(keys_file=file), Metrics())
    good = file.read_text()
    if broken is None:
        file.unlink()
    else:
        file.write_text(broken)
    with capture_logs() as logs:
        assert not gate.refresh()
        assert not gate.refresh()
    [entry] = logs
    assert entry["event"] == "keys not reloaded; the former ones stay in use"
    assert str(file) in entry["reason"]
    assert gate.identify("Bearer first").name == "one"
    assert gate.broken
    file.write_text(good)
    assert gate.refresh()
    assert not gate.broken


async def test_a_file_without_keys_lets_nobody_in(file: Path) -> None:
    gate = Gate(Settings(keys_file=file), Metrics())
    write_keys(file, [])
    assert gate.refresh()
    with capture_logs() as logs:
        gate.apply()
    assert [entry["event"] for entry in logs] == ["no keys: nobody is let in"]
    with pytest.raises(Unauthenticated):
        gate.identify("Bearer first")


def test_a_missing_file_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"keys_file: .*nowhere\.json: No such file"):
        Gate(Settings(keys_file=tmp_path / "nowhere.json"), Metrics())


@pytest.mark.parametrize("address", ["0.0.0.0:1", "[::]:1", "192.0.2.1:1", "*:1", "name:1"])
@pytest.mark.parametrize("name", ["http", "grpc"])
def test_without_keys_only_loopback_is_allowed(name: str, address: str, file: Path) -> None:
    chosen: dict[str, Any] = {name: address}
    opened = Settings(**chosen)
    with pytest.raises(SettingsError, match=f"{name}: .*other machines.*FORECAST_ALLOW_ANYONE=true"):
        require_protection(opened)
    for permitted in ({"allow_anyone": True}, {"api_tokens": ("x",)}, {"keys_file": file}):
        require_protection(Settings(**(chosen | permitted)))


@pytest.mark.parametrize("address", ["127.0.0.1:1", "127.1.2.3:1", "[::1]:1", "localhost:1"])
def test_loopback_needs_no_keys(address: str) -> None:
    require_protection(Settings(http=address, grpc=address))
