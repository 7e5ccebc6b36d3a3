"""``cab-forecast keys``: the file that it writes, and what it says."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from cli.keys import Scope as Offered
from cli.main import app
from service.access.gate import Gate
from service.access.key_file import read_keys
from service.access.scopes import Scope
from service.settings import Settings
from service.telemetry.metrics import Metrics

run = CliRunner().invoke


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "keys.json"
    monkeypatch.setenv("FORECAST_KEYS_FILE", str(path))
    return path


def test_a_new_key_is_printed_once_and_let_in(file: Path) -> None:
    limits = ["--agents-per-second", "50", "--concurrent-agents", "8", "--streams", "1"]
    added = run(app, ["keys", "add", "planner", "--scope", "predict", "--scope", "read", *limits])
    assert added.exit_code == 0, added.output
    [key] = added.stdout.splitlines()
    assert key not in added.stderr
    assert key not in file.read_text()
    assert Gate(Settings(keys_file=file), Metrics()).identify(f"Bearer {key}").name == "planner"
    [entry] = read_keys(file)
    assert (entry.agents_per_second, entry.concurrent_agents, entry.streams) == (50, 8, 1)
    assert run(app, ["keys", "add", "other"]).exit_code == 0
    assert run(app, ["keys", "list"]).stdout.splitlines() == [
        "planner: predict, read, at most 50 agents/s, at most 8 agents at a time, at most 1 streams",
        "other: predict",
    ]
    assert run(app, ["keys", "remove", "planner"]).exit_code == 0
    assert [entry.name for entry in read_keys(file)] == ["other"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["add", "taken"], "has a key for taken already"),
        (["add", "Two Words"], "name: String should match"),
        (["add", "x", "--agents-per-second", "-1"], "agents_per_second: Input should be greater than 0"),
        (["remove", "nobody"], "has no key for nobody"),
        (["list", "--file", "nowhere.json"], "nowhere.json: No such file or directory"),
    ],
)
def test_what_cannot_be_done_is_said_and_changes_nothing(
    file: Path, arguments: list[str], message: str
) -> None:
    run(app, ["keys", "add", "taken"])
    before = file.read_text()
    refused = run(app, ["keys", *arguments])
    assert refused.exit_code == 1
    assert message in refused.stderr
    assert file.read_text() == before


def test_all_scopes_are_offered() -> None:
    assert [scope.value for scope in Offered] == [scope.value for scope in Scope]
