"""The map of the code in docs/architecture.md fits the code."""

import ast
import functools
import re
from pathlib import Path

import pytest

from tests.docs.pages import ROOT

PAGE = ROOT / "docs/architecture.md"
MAX_STOPS = 12
_TEXT = PAGE.read_text(encoding="utf-8")
_FILE = re.compile(r"`((?:[\w.-]+/)+[\w.-]+\.\w+)(?:: ([\w.]+))?`")
_WALK = re.compile(r"^## (One [^\n]+)\n(.*?)(?=^## )", re.MULTILINE | re.DOTALL)
_STOP = re.compile(r"^\d+\. ", re.MULTILINE)

FILES = sorted({(path, name) for path, name in _FILE.findall(_TEXT)})
WALKS = dict(_WALK.findall(_TEXT))


@pytest.mark.parametrize(("path", "name"), FILES, ids=[f"{path}: {name}" for path, name in FILES])
def test_a_named_place_exists(path: str, name: str) -> None:
    file = ROOT / path
    assert file.is_file()
    if not name:
        return
    if file.suffix == ".py":
        assert name in _defined(file)
    else:
        assert re.search(rf"\b{re.escape(name)}\b", file.read_text(encoding="utf-8"))


def test_the_walks_are_short() -> None:
    assert list(WALKS) == [
        "One Predict call",
        "One Explain call",
        "One track-memory call",
        "One frame for watchers",
        "One training step",
        "One benchmark run",
    ]
    for walk, text in WALKS.items():
        stops = _STOP.split(text)[1:]
        assert 1 < len(stops) <= MAX_STOPS, walk
        for stop in stops:
            assert _FILE.search(stop), f"{walk}: no file is named in: {stop}"


@pytest.mark.parametrize(
    "question",
    [
        "Where is a deadline enforced?",
        "Where is CAB's KL term?",
        "How do I add a baseline?",
        "How do I add a map layer?",
    ],
)
def test_a_newcomer_finds_the_place(question: str) -> None:
    found = re.search(rf"^### {re.escape(question)}\n(.*?)(?=^#|\Z)", _TEXT, re.MULTILINE | re.DOTALL)
    assert found is not None
    assert _FILE.search(found[1]) is not None, "the answer names no file"


def test_every_package_has_its_row() -> None:
    rows = re.findall(r"^\| `([\w/]+)/`", _TEXT, re.MULTILINE)
    ours = {folder.parent.name for folder in ROOT.glob("*/__init__.py")}
    assert ours <= set(rows)
    for row in rows:
        assert (ROOT / row).is_dir()


def test_names_are_read_from_the_code() -> None:
    defined = _defined(ROOT / "service/settings.py")
    assert {"Settings", "Settings.http", "load", "FALLBACK_MODEL"} <= defined
    assert "Settings.nothing" not in defined


@functools.cache
def _defined(file: Path) -> frozenset[str]:
    """Return the names that a module defines, and those of its classes as ``Class.name``."""
    return frozenset(_names(ast.parse(file.read_text(encoding="utf-8")).body, ""))


def _names(body: list[ast.stmt], prefix: str) -> list[str]:
    found = []
    for node in body:
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                found.append(prefix + name)
            case ast.ClassDef(name=name):
                found += [prefix + name, *_names(node.body, f"{prefix}{name}.")]
            case ast.AnnAssign(target=ast.Name(id=name)):
                found.append(prefix + name)
            case ast.Assign(targets=[ast.Name(id=name)]):
                found.append(prefix + name)
    return found
