"""A server, and a folder in which the examples are started by the lines of their README."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from service.server import Server
from service.settings import Settings
from tests.docs.pages import ROOT, blocks
from tests.service.servers import in_thread

Run = subprocess.CompletedProcess[str]


@pytest.fixture(scope="package")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with CAB and Trajectron++."""
    models = tmp_path_factory.mktemp("models")
    for name in ("cab", "trajectron"):
        (models / name).symlink_to(ROOT / "model/checkpoints" / name)
    settings = Settings(http="127.0.0.1:0", grpc="127.0.0.1:0", models=models, max_batch_agents=8)
    with in_thread(settings) as running:
        yield running


@pytest.fixture
def start(server: Server, tmp_path: Path) -> Callable[[str], Run]:
    """Return a function that runs the README's line with an example, against the server, and waits for it.

    It runs in a copy of the examples beside links to what else they use. `.venv` there is this environment.
    """
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    (tmp_path / "proto").symlink_to(ROOT / "proto")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    return lambda example: run(line(example), server, tmp_path)


def line(example: str) -> str:
    """Return the command line of examples/README.md that starts an example."""
    [found] = [code for code in blocks(ROOT / "examples/README.md", "bash") if f"examples/{example}" in code]
    return found


def run(command: str, server: Server, folder: Path) -> Run:
    """Run a command line against a server."""
    command = command.replace("127.0.0.1:50051", server.grpc_address)
    command = command.replace("127.0.0.1:8080", server.http_address)
    variables = {
        **os.environ,
        "CAB_FORECAST_ENDPOINT": f"grpc://{server.grpc_address}",
        "PYTHONPATH": f"{ROOT}:{ROOT / 'proto'}",
    }
    return subprocess.run(  # noqa: S603
        ["bash", "-c", command],  # noqa: S607
        cwd=folder,
        env=variables,
        capture_output=True,
        check=False,
        text=True,
        timeout=120,
    )
