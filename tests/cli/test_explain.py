"""``cab-forecast explain`` against a real server with the baselines alone."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cab_forecast import demo_request
from cli.main import app
from tests.service.servers import in_thread, settings

run = CliRunner().invoke
FIRST, SECOND = (agent.id for agent in demo_request().agents[:2])


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    models = tmp_path_factory.mktemp("no-models")
    with in_thread(settings(models=models, max_batch_agents=8)) as server:
        yield server.grpc_address


@pytest.fixture(autouse=True)
def endpoint(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAB_FORECAST_ENDPOINT", f"grpc://{address}")


def test_a_table_and_a_plot_of_two_models(tmp_path: Path) -> None:
    file = tmp_path / "plot.png"
    options = ["--model=kalman,constant-velocity-yaw", f"--agent={FIRST}", f"--plot={file}"]
    result = run(app, ["explain", "demo", *options])
    assert result.exit_code == 0, result.stderr
    assert result.stdout.count(FIRST) == 2
    assert SECOND not in result.stdout
    assert "kalman@" in result.stdout
    assert "no donors" in result.stdout
    assert file.stat().st_size > 10_000


def test_json() -> None:
    options = ["--json", f"--agent={FIRST}", "--baseline=null-context", "--horizon=2"]
    result = run(app, ["explain", "demo", *options])
    answer = json.loads(result.stdout.splitlines()[-1])  # before it are lines of the server
    [explanation] = answer["explanations"]
    assert explanation["state"]["nearer"] > 0
    assert (answer["horizon"], answer.get("warnings", [])) == (2.0, [])


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--agent=nobody"], "no agent nobody"),
        (["--model=nobody"], "no model"),
        (["--permutations=7"], "even number"),
    ],
)
def test_faults_are_one_line(options: list[str], text: str) -> None:
    result = run(app, ["explain", "demo", *options])
    assert result.exit_code == 1
    assert text in result.stderr
    assert result.stderr.count("\n") == 1
