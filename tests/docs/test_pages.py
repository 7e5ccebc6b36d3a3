"""Existence of all that the documentation names: links, paths, make targets, commands, flags, settings."""

import importlib
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.core import TyperGroup

import loadtest.__main__
from cab.forecast.v1.prediction_service_pb2 import ForecastStatus
from cli.main import app
from docs import generate
from model.networks.config import NetworkConfig
from model.training.config import TrainingConfig
from service.environment import CONFIG, PREFIX
from service.settings import Settings
from tests.docs.pages import PAGES, README, ROOT, anchors, commands, links, name, spans

MAX_README_BYTES = 8_000
MAX_PICTURE_BYTES = 150_000
_FOLDERS = {
    folder.name
    for folder in ROOT.iterdir()
    if folder.is_dir() and not folder.name.startswith(".") and folder.name != "build"  # which make writes
}
_PATH = re.compile(r"[\w.-]+(?:/[\w.*-]*)+")
_MODULE = re.compile(r"(?:model|service|benchmark|loadtest|cab_forecast|cli|docs)(?:\.(?!yml|py|md)\w+)+")
_FOREIGN_FLAGS = {
    "--build",
    "--build-arg",
    "--enable-feature",
    "--hash",
    "--nproc-per-node",
    "--profile",
    "--rm",
}
"""Flags of other programs."""

pages = pytest.mark.parametrize("page", PAGES, ids=name)


def test_the_readme_is_short_and_has_one_small_picture() -> None:
    assert README.stat().st_size <= MAX_README_BYTES
    [picture] = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README.read_text(encoding="utf-8"))
    assert (ROOT / picture).stat().st_size <= MAX_PICTURE_BYTES


def test_the_readme_leads_to_every_page() -> None:
    linked = {(ROOT / link).resolve() for link in links(README) if "://" not in link}
    assert {page for page in PAGES if page.parent == ROOT / "docs"} <= linked


@pages
def test_links_lead_somewhere(page: Path) -> None:
    for link in links(page):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


@pages
def test_paths_exist(page: Path) -> None:
    if page.name == "CHANGELOG.md":  # tells of the past, too
        return
    for span in spans(page):
        if _PATH.fullmatch(span) and span.split("/")[0] in _FOLDERS and not re.search(r"/[A-Z]+\b", span):
            assert list(ROOT.glob(span.rstrip("/"))), span


@pages
def test_modules_exist(page: Path) -> None:
    for span in spans(page):
        if _MODULE.fullmatch(span):
            path = ROOT / span.replace(".", "/")
            if not (path.is_dir() or path.with_suffix(".py").is_file()):
                module, _, attribute = span.rpartition(".")
                assert hasattr(importlib.import_module(module), attribute), span


@pages
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = {target for line in commands(page) for target in re.findall(r"^make ([\w-]+)", line)}
    assert named <= targets


@pages
def test_commands_and_their_flags_exist(page: Path) -> None:
    for line in commands(page):
        if (found := re.search(r"(?:\bcab-forecast|-m service|-m cli) ([a-z].*)", line)) is not None:
            words = re.split(r"\s+(?:[|&<>]|$)", found[1])[0].split()
            command, rest = _command(words)
            assert command is not None, line
            flags = {word.partition("=")[0] for word in rest if word.startswith("--")}
            assert flags <= _flags(command), line


@pages
def test_flags_alone_exist(page: Path) -> None:
    load_test = _every_flag(typer.main.get_command(loadtest.__main__.app))
    known = _every_flag(typer.main.get_group(app)) | load_test | _FOREIGN_FLAGS
    named = {flag for span in spans(page) for flag in re.findall(r"(?<![\w-])--[a-z][\w-]*", span)}
    assert named <= known


@pages
def test_environment_variables_are_settings(page: Path) -> None:
    known = {PREFIX + setting.upper() for setting in Settings.model_fields} | {CONFIG, *ForecastStatus.keys()}
    named = set(re.findall(rf"(?<!CAB_)\b{PREFIX}[A-Z_]*[A-Z]", page.read_text(encoding="utf-8")))
    assert named <= known


def test_settings_of_training_exist() -> None:
    known = _names(TrainingConfig) | _names(NetworkConfig)
    text = (ROOT / "docs/training.md").read_text(encoding="utf-8")
    named = set(re.findall(r"^\| `\[?([a-z_]+)\]?`", text, re.MULTILINE))
    assert len(named) > 10
    assert named <= known


def test_every_dependency_has_its_reason() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in (ROOT / "docs/dependencies.md").read_text(encoding="utf-8").splitlines()
        if line.startswith("|")
    ]
    serving = {row[0] for row in rows if len(row) == 2} - {"Package", "---"}
    extras = {(row[0], row[1]) for row in rows if len(row) == 3} - {("Extra", "Package"), ("---", "---")}
    assert serving == {_package(one) for one in project["dependencies"]}
    assert extras == {
        (extra, _package(one)) for extra, all_ in project["optional-dependencies"].items() for one in all_
    }


def test_the_flags_of_serve_are_in_the_table_of_settings() -> None:
    no_settings = {"config", "demo", "help"}
    assert generate.serve_flags().keys() - no_settings <= Settings.model_fields.keys()


def _command(words: list[str]) -> tuple[Any, list[str]]:
    """Return the command that words name, None if there is none, and the words after it."""
    command: Any = typer.main.get_group(app)
    while isinstance(command, TyperGroup) and words and words[0].strip(",;") in command.commands:
        command, words = command.commands[words[0].strip(",;")], words[1:]
    return (None if command.name == "cab-forecast" else command), words


def _flags(command: Any) -> set[str]:
    found = {opt for parameter in command.params for opt in (*parameter.opts, *parameter.secondary_opts)}
    return found | {"--help"}


def _every_flag(command: Any) -> set[str]:
    found = _flags(command)
    for one in command.commands.values() if isinstance(command, TyperGroup) else ():
        found |= _every_flag(one)
    return found


def _names(config: type[TrainingConfig] | type[NetworkConfig]) -> set[str]:
    return set(config.model_fields)


def _package(requirement: str) -> str:
    found = re.match(r"[\w.-]+(?:\[\w+\])?", requirement)
    assert found is not None
    return found[0]
