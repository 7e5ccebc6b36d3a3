"""The file of keys."""

import json
from pathlib import Path
from typing import Any

import pytest

from service.access.key_file import (
    MAX_KEYS,
    PREFIX,
    Key,
    KeyFileError,
    digest,
    new_key,
    read_keys,
    write_keys,
)
from service.access.scopes import Scope

ENTRY = {"name": "planner", "sha256": "a" * 64, "scopes": ["predict"]}


def test_a_key_is_written_as_its_hash(tmp_path: Path) -> None:
    file = tmp_path / "keys.json"
    text, key = new_key("planner", [Scope.PREDICT, Scope.READ], agents_per_second=7.5, concurrent_agents=3)
    other, _ = new_key("planner", [])
    assert text.startswith(PREFIX)
    assert len(text) > 40
    assert text != other
    write_keys(file, [key])
    assert read_keys(file) == (key,)
    assert digest(text) == key.sha256
    assert text.removeprefix(PREFIX) not in file.read_text()
    assert key.sha256 not in repr(key)
    assert [path.name for path in tmp_path.iterdir()] == ["keys.json"]


def test_a_file_keeps_its_mode(tmp_path: Path) -> None:
    file = tmp_path / "keys.json"
    write_keys(file, [])
    assert file.stat().st_mode & 0o777 == 0o644
    file.chmod(0o600)
    write_keys(file, [])
    assert file.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ([ENTRY | {"name": "Two words"}], "keys.0.name"),
        ([ENTRY | {"name": "(api_tokens)"}], "keys.0.name"),
        ([ENTRY | {"sha256": "secret"}], "keys.0.sha256"),
        ([ENTRY | {"scopes": ["all"]}], "keys.0.scopes.0"),
        ([ENTRY | {"agents_per_second": 0}], "keys.0.agents_per_second"),
        ([ENTRY | {"concurrent_agents": 0}], "keys.0.concurrent_agents"),
        ([ENTRY | {"key": "secret"}], "keys.0.key"),
        ([ENTRY, ENTRY | {"sha256": "b" * 64}], "two keys have the same name"),
        ([ENTRY, ENTRY | {"name": "other"}], "two keys have the same sha256"),
        ([{**ENTRY, "name": f"k{n}", "sha256": f"{n:064x}"} for n in range(MAX_KEYS + 1)], "at most 256"),
        (None, "keys"),
    ],
)
def test_what_is_wrong_is_named_without_its_value(tmp_path: Path, keys: Any, message: str) -> None:
    file = tmp_path / "keys.json"
    file.write_text(json.dumps({"keys": keys}))
    with pytest.raises(KeyFileError, match=message) as caught:
        read_keys(file)
    assert str(file) in str(caught.value)
    assert "secret" not in str(caught.value)
    assert "a" * 64 not in str(caught.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(KeyFileError, match="No such file"):
        read_keys(tmp_path / "nowhere.json")
    (tmp_path / "empty.json").write_text("")
    with pytest.raises(KeyFileError, match="Invalid JSON"):
        read_keys(tmp_path / "empty.json")
    with pytest.raises(KeyFileError, match="No such file"):
        write_keys(tmp_path / "nowhere" / "keys.json", [])


def test_names_of_new_keys_are_checked() -> None:
    with pytest.raises(KeyFileError, match="name"):
        new_key("Planner", [])
    with pytest.raises(KeyFileError, match="concurrent_agents"):
        new_key("planner", [], concurrent_agents=-1)
    assert Key.model_validate(ENTRY).agents_per_second is None
