"""The wheel, the image and the pins hold what the program needs, and the program needs nothing private."""

import ast
import asyncio
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterator
from importlib import metadata
from inspect import signature
from pathlib import Path
from typing import Any

import pytest
import redis.asyncio.cluster
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
UNSHIPPED = {"loadtest", "docs", "tests"}
"""Folders with Python code that the wheel leaves out."""
PRIVATE = {
    "service/tracking/store/redis/cluster.py": {"redis._parsers", "redis._parsers.AsyncCommandsParser"},
}
"""Private names of dependencies that are used, by file; each has a test below that says what breaks."""
DOCUMENTED = {"os._exit"}
"""Names that begin with an underscore and are part of the standard library's interface all the same."""


def packages() -> set[str]:
    """Return the top-level folders that the wheel holds."""
    listed = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    return {Path(name).parts[0] for name in listed}


def ours() -> set[str]:
    """Return the names of the project's own top-level packages."""
    return {"cab", *packages(), *UNSHIPPED} - {"proto"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Return the names of the files in a built wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)  # noqa: S603
    [file] = folder.glob("*.whl")
    return set(zipfile.ZipFile(file).namelist())


def imports(source: str) -> Iterator[tuple[str, str | None]]:
    """Yield the absolute imports of a module, also those inside functions: module, and name in it."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((each.name, None) for each in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield from ((node.module, each.name) for each in node.names)


def files_of(name: str) -> tuple[str, str]:
    """Return the two files that a module can be in."""
    path = name.replace(".", "/")
    return f"{path}.py", f"{path}/__init__.py"


def test_the_image_is_built_from_all_packages() -> None:
    copied = {
        words[1]
        for words in map(str.split, (ROOT / "Dockerfile").read_text().splitlines())
        if words[:1] == ["COPY"] and len(words) == 3 and words[1] == words[2]
    }
    assert copied == packages()
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert packages() <= sent


def test_the_makefile_names_modules_and_tests_that_exist() -> None:
    text = (ROOT / "Makefile").read_text()
    modules = re.findall(r"python -m ([\w.]+)", text)
    own = [name for name in modules if name.partition(".")[0] in ours()]
    assert own
    for name in own:
        assert any((ROOT / file).is_file() for file in files_of(name)), name
    tests = re.findall(r"tests/\S+\.py", text)
    assert tests
    for file in tests:
        assert (ROOT / file).is_file(), file


def test_every_package_is_type_checked_and_says_so() -> None:
    checked = set(PROJECT["tool"]["mypy"]["packages"]) | {"proto"}
    assert packages() <= checked
    for name in packages() - {"proto"}:
        assert (ROOT / name / "py.typed").is_file(), name


def test_the_wheel_holds_all_that_its_modules_import(wheel: set[str]) -> None:
    """Beginning with the console script, and with the extras' modules, which are imported in functions."""
    [entry] = PROJECT["project"]["scripts"].values()
    assert wheel & set(files_of(entry.partition(":")[0]))
    for file in sorted(name for name in wheel if name.endswith(".py")):
        source = (ROOT / ("proto" if file.startswith("cab/") else "") / file).read_text(encoding="utf-8")
        for module, name in imports(source):
            if module.partition(".")[0] not in ours():
                continue
            as_module = wheel & set(files_of(module))
            of_package = name is not None and wheel & set(files_of(f"{module}.{name}"))
            assert as_module or of_package, f"{file} imports {module}, which is not in the wheel"


def test_the_wheel_holds_every_file_of_its_packages(wheel: set[str]) -> None:
    """Checkpoints, methods, Lua scripts and templates are read from where the package is."""
    tracked = subprocess.run(  # noqa: S603
        ["git", "ls-files", *sorted(packages())],  # noqa: S607
        cwd=ROOT,
        check=False,
        capture_output=True,
        text=True,
    )
    if tracked.returncode:
        pytest.skip("this is no checkout of the repository")
    there = {file.removeprefix("proto/") for file in tracked.stdout.splitlines() if (ROOT / file).is_file()}
    assert there <= wheel


def test_every_dependency_is_pinned() -> None:
    """All but the extras that need another environment or no test."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = {
        canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines)
    }
    needed = [*PROJECT["project"]["dependencies"]]
    for extra in ("plot", "dev"):
        needed += PROJECT["project"]["optional-dependencies"][extra]
    for requirement in map(Requirement, needed):
        name = canonicalize_name(requirement.name)
        if name != PROJECT["project"]["name"]:
            assert requirement.specifier.contains(pinned[name]), name


def test_the_image_installs_what_is_pinned_by_hash() -> None:
    """Hashed are all that the image can hold except torch, in the versions that the tests run with."""
    text = (ROOT / "requirements-image.txt").read_text()
    entries = re.findall(
        r"^([\w.-]+)==(\S+) \\\n    --hash=sha256:[0-9a-f]{64}(?: \\)?\n", text, re.MULTILINE
    )
    assert len(entries) == text.count("==")
    hashed = {canonicalize_name(name): version for name, version in entries}
    pins = (line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines())
    pinned = {canonicalize_name(name): version for name, version in pins}
    # What pip freeze leaves out
    assert {name: hashed[name] for name in hashed.keys() - {"setuptools"}}.items() <= pinned.items()
    extras = PROJECT["project"]["optional-dependencies"]
    needed = [*PROJECT["project"]["dependencies"], *PROJECT["build-system"]["requires"], "psutil"]
    needed += [*extras["plot"], *extras["record"], *extras["tracing"]]
    names = {canonicalize_name(Requirement(each).name) for each in needed}
    assert names - hashed.keys() == {"torch"}
    # What these need in turn, as far as the installed packages tell
    for name in names - {"torch"}:
        for each in map(Requirement, metadata.requires(name) or ()):
            if each.marker is None or each.marker.evaluate({"extra": ""}):
                assert canonicalize_name(each.name) in hashed, f"{each.name}, which {name} needs"


def test_the_licence_names_that_of_the_weights() -> None:
    """The wheel holds checkpoints trained on nuScenes."""
    assert (ROOT / "model/checkpoints").is_dir()
    assert PROJECT["project"]["license"] == "Apache-2.0 AND LicenseRef-nuScenes-NonCommercial"


def is_private(name: str) -> bool:
    """Return whether a part of a dotted name is private; ``__future__`` and its like are not."""
    return any(part.startswith("_") and not part.endswith("__") for part in name.split("."))


def private_names(source: str) -> set[str]:
    """Return the private names of dependencies that a module imports, or takes of what it imports."""
    found, bound = set(), {}
    for module, name in imports(source):
        if module.partition(".")[0] in ours():
            continue
        whole = module if name is None else f"{module}.{name}"
        bound[whole if name is None else name] = whole
        found |= {each for each in (module, whole) if is_private(each)}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            root = node.value
            while isinstance(root, ast.Attribute):
                root = root.value
            if isinstance(root, ast.Name) and root.id in bound:
                found.add(ast.unparse(node))
    return found


def test_private_names_are_found() -> None:
    for source, name in (
        ("from redis._parsers import x", "redis._parsers"),
        ("def f():\n  import torch._C", "torch._C"),
        ("from grpc import _channel", "grpc._channel"),
        ("import torch\ntorch._C.x()", "torch._C"),
        ("from grpc import aio\naio.a._b", "aio.a._b"),
    ):
        assert name in private_names(source), source
    for source in (
        "from __future__ import annotations",
        "import torch\ntorch.__version__",
        "self._x",
        "import model._x",
    ):
        assert not private_names(source), source


def test_no_private_name_of_a_dependency_is_used_unless_a_test_says_what_breaks() -> None:
    used = {}
    for package in sorted(ours() - {"cab"}):
        for file in sorted((ROOT / package).rglob("*.py")):
            if names := private_names(file.read_text(encoding="utf-8")) - DOCUMENTED:
                used[str(file.relative_to(ROOT))] = names
    assert used == PRIVATE


def test_redis_py_still_has_the_private_parser_that_the_cluster_client_replaces() -> None:
    """``service.tracking.store.redis.cluster`` replaces redis-py's parser by one that asks only if needed.

    Where this fails, a newer redis-py no longer looks at the parser, or looks at it otherwise. Then the
    replacement does nothing, and each look at a cluster's topology stops the event loop for 40 ms again; or
    the import fails, and no Redis store can be opened.
    """
    parser = redis.asyncio.cluster.RedisCluster("127.0.0.1", 1).commands_parser
    assert type(parser).__module__.startswith("redis._parsers")
    assert type(parser).__name__ == "AsyncCommandsParser"
    assert list(signature(parser.initialize).parameters) == ["node"]
    asked: list[Any] = []

    class Node:
        async def execute_command(self, *words: Any) -> dict[str, Any]:
            asked.append(words)
            return {
                "GET": {"name": "get", "flags": [], "first_key_pos": 1, "last_key_pos": 1, "step_count": 1}
            }

    async def look() -> None:
        await parser.initialize(Node())  # type: ignore[arg-type]
        assert await parser.get_keys("GET", "key")
        assert "get" in parser.commands

    asyncio.run(look())
    assert asked == [("COMMAND",)]
