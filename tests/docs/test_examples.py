"""The examples of the documentation work as printed, but for the server's address."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from model import registry
from service.server import Server
from service.settings import Settings
from tests.docs.pages import PAGES, README, ROOT, blocks, name
from tests.service.servers import in_thread


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with the bundled CAB alone."""
    models = tmp_path_factory.mktemp("models")
    (models / "cab").symlink_to(ROOT / "model/checkpoints/cab")
    settings = Settings(http="127.0.0.1:0", grpc="127.0.0.1:0", models=models, max_batch_agents=8)
    with in_thread(settings) as running:
        yield running


def test_the_first_forecast_in_python(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    [code] = blocks(README, "python")
    exec(_here(code, server), {})  # noqa: S102 - our own README
    printed = capsys.readouterr().out
    assert "car OK" in printed
    assert "walker FALLBACK forecast by constant-velocity-yaw" in printed


@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not here")
def test_the_first_forecast_with_curl(server: Server) -> None:
    [code] = blocks(README, "bash")
    run = subprocess.run(["bash", "-c", _here(code, server)], capture_output=True, check=True, text=True)  # noqa: S603, S607
    decoder = json.JSONDecoder()
    forecast, end = decoder.raw_decode(run.stdout)
    models, _ = decoder.raw_decode(run.stdout[end:].lstrip())
    assert [one["agent_id"] for one in forecast["forecasts"]] == ["car"]
    assert forecast["model"]["name"] == "cab"
    assert "cab" in {model["name"] for model in models["models"]}


def test_the_example_of_the_client(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    [code] = blocks(ROOT / "docs/client.md", "python")
    exec(_here(code, server).replace("timeout=0.5", "timeout=5"), {})  # noqa: S102
    assert "walker FALLBACK" in capsys.readouterr().out


def test_the_example_of_the_maps(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    [code] = blocks(ROOT / "docs/maps.md", "python")
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    exec(_here(code, server).replace("timeout=2.0", "timeout=10"), {})  # noqa: S102
    assert (tmp_path / "own_map.png").stat().st_size > 10_000


def test_the_example_of_the_benchmark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    [code] = blocks(ROOT / "docs/benchmark.md", "python")
    monkeypatch.chdir(tmp_path)
    exec(code, {})  # noqa: S102
    assert float(capsys.readouterr().out) > 0
    assert {"results.json", "tables.md"} <= {file.name for file in (tmp_path / "runs/kalman").iterdir()}


def test_the_example_of_a_baseline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model, run = blocks(ROOT / "docs/baseline.md", "python")
    module = ModuleType("model.baselines.slowing")
    exec(model, vars(module))  # noqa: S102
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(registry, "_BASELINES", (*registry._BASELINES, module.__name__))
    assert registry.Registry.load(None).get("slowing").info.full_name == "slowing@1.0.0"
    monkeypatch.chdir(tmp_path)
    exec(run, {})  # noqa: S102
    printed = dict(line.split()[:2] for line in capsys.readouterr().out.splitlines())
    assert {"kalman", "slowing"} <= printed.keys()
    assert all(0 < float(error) < 50 for error in printed.values())


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_python_compiles(page: Path) -> None:
    for code in blocks(page, "python"):
        compile(code, name(page), "exec")


def _here(code: str, server: Server) -> str:
    """Return code with the addresses of a server on free ports."""
    return code.replace("127.0.0.1:50051", server.grpc_address).replace("127.0.0.1:8080", server.http_address)
