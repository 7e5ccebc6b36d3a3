"""``cab-forecast demo``."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cli.demo import running_demo
from cli.main import app
from tests.cab_forecast.fakes import Script, grpc_fake


@pytest.fixture
def script() -> Script:
    """Return a server that answers at once."""
    return Script()


@pytest.fixture
def address(script: Script) -> Iterator[str]:
    """Serve it."""
    with grpc_fake(script) as served:
        yield served


def test_it_says_what_it_does(script: Script, address: str) -> None:
    options = ["--scene", "roundabout", "--agents", "8", "--seconds", "1", "--endpoint", address]
    result = CliRunner().invoke(app, ["demo", *options])
    assert result.exit_code == 0, result.output
    (line,) = result.stdout.splitlines()
    assert " agents, " in line
    assert " ms each" in line
    assert {request.scene_id for request in script.predicted} == {"demo/roundabout"}


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            ["--scene", "moon"],
            "--scene: 'moon' is not one of junction, roundabout, highway and nuscenes_pred:DIR",
        ),
        (["--scene", "nuscenes_pred:/no/such"], "/no/such/label/val: there are no label files"),
        (["--scene", "nuscenes_pred:/no/such", "--rate", "10"], "recorded scenes have 2 ticks a second"),
    ],
)
def test_failures_end_with_one_line(options: list[str], told: str) -> None:
    result = CliRunner().invoke(app, ["demo", *options])
    assert result.exit_code == 1
    assert told in result.stderr


def test_without_a_server_it_says_so_and_goes_on() -> None:
    result = CliRunner().invoke(app, ["demo", "--seconds", "1", "--endpoint", "grpc://127.0.0.1:1"])
    assert result.exit_code == 0
    assert "demo: no forecast: no connection to grpc://127.0.0.1:1" in result.stderr


def test_ctrl_c_ends_it_cleanly(script: Script, address: str) -> None:
    command = [sys.executable, "-m", "cli", "demo", "--scene", "roundabout", "--endpoint", address]
    with subprocess.Popen(  # noqa: S603 - ourselves
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell that runs the tests in the background ignores SIGINT, and its children would, too
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(signal.SIGINT)
        shown, said = process.communicate(timeout=20)
    assert process.returncode == 0
    assert shown.splitlines()[-1] == "demo: ended"
    assert not said


def test_a_demo_beside_a_server_ends_with_the_block(script: Script, address: str) -> None:
    with running_demo(address, "secret"):
        _until(lambda: len(script.predicted) > 2)
    assert script.calls[0]["authorization"] == "Bearer secret"
    count = len(script.predicted)
    time.sleep(0.3)
    assert len(script.predicted) == count


def test_a_demo_beside_a_server_ends_when_that_is_killed(
    script: Script, address: str, tmp_path: Path
) -> None:
    code = (
        "import time\nfrom cli.demo import running_demo\n"
        f"with running_demo({address!r}, None):\n    time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code]) as parent:  # noqa: S603 - ourselves
        _until(lambda: len(script.predicted) > 2)
        parent.kill()
        parent.wait()
        time.sleep(0.5)
        count = len(script.predicted)
        time.sleep(0.5)
    assert len(script.predicted) == count


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)
