"""``cab-forecast predict`` against a fake server."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from google.protobuf import json_format
from typer.testing import CliRunner

from cab.forecast.v1.prediction_service_pb2 import CONTEXT_BLIND, PredictResponse
from cab_forecast import demo_request
from cli.main import app
from tests.cab_forecast.answers import answer
from tests.cab_forecast.fakes import Failure, Script, free_port, grpc_fake

run = CliRunner().invoke


@pytest.fixture
def script() -> Script:
    """Return the fake server's script."""
    return Script()


@pytest.fixture(autouse=True)
def server(script: Script, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Run a fake server at the command's default endpoint."""
    with grpc_fake(script) as address:
        monkeypatch.setenv("CAB_FORECAST_ENDPOINT", f"grpc://{address}")
        yield


def test_prints_a_table() -> None:
    result = run(app, ["predict", "demo"])
    assert result.exit_code == 0
    assert "vehicle-" in result.stdout
    assert "model fan@1.0.0" in result.stdout


def test_options_replace_those_of_the_request(script: Script) -> None:
    options = ["--model=m@1", "--samples=2", "--seed=0", "--horizon=1.5", "--max-modes=3", "--token=t"]
    options += ["--blind", "--strict"]
    assert run(app, ["predict", "demo", *options]).exit_code == 0
    (request,) = script.predicted
    assert request.model == "m@1"
    sent = request.options
    assert (sent.samples, sent.seed, sent.horizon, sent.max_modes) == (2, 0, 1.5, 3)
    assert sent.HasField("seed")
    assert sent.context == CONTEXT_BLIND
    assert sent.strict
    assert script.calls[0]["authorization"] == "Bearer t"


def test_the_request_is_left_alone_otherwise(script: Script) -> None:
    run(app, ["predict", "demo"])
    assert script.predicted == [demo_request()]


def test_modes_are_merged_unless_all_are_asked_for(script: Script) -> None:
    for merge in (False, True):
        request = demo_request()
        request.options.merge = merge
        content = request.SerializeToString()
        assert run(app, ["predict", "-"], input=content).exit_code == 0
        assert run(app, ["predict", "-", "--all-modes"], input=content).exit_code == 0
    assert [request.options.merge for request in script.predicted] == [True, False, True, False]


@pytest.mark.parametrize("name", ["request.json", "request.binpb"])
def test_a_saved_request_can_be_sent(script: Script, tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    assert run(app, ["predict", "demo", "--max-modes", "2", "--save-request", str(path)]).exit_code == 0
    assert not script.calls
    assert run(app, ["predict", str(path)]).exit_code == 0
    assert script.predicted[0].options.max_modes == 2


@pytest.mark.parametrize("binary", [True, False])
def test_reads_standard_input(script: Script, binary: bool) -> None:
    request = demo_request()
    content = request.SerializeToString() if binary else json_format.MessageToJson(request).encode()
    assert run(app, ["predict", "-"], input=content).exit_code == 0
    assert script.predicted == [request]


@pytest.mark.parametrize("name", ["answer.json", "answer.binpb"])
def test_writes_the_answer(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    assert run(app, ["predict", "demo", "--output", str(path)]).exit_code == 0
    content, response = path.read_bytes(), PredictResponse()
    if name.endswith(".json"):
        json_format.Parse(content, response)
    else:
        response.ParseFromString(content)
    assert response == answer(demo_request())


def test_prints_json_and_nothing_else() -> None:
    result = run(app, ["predict", "demo", "--json"])
    assert json_format.ParseDict(json.loads(result.stdout), PredictResponse()) == answer(demo_request())


def test_draws_a_picture(tmp_path: Path) -> None:
    path = tmp_path / "out.png"
    assert run(app, ["predict", "demo", "--plot", str(path)]).exit_code == 0
    assert path.read_bytes().startswith(b"\x89PNG")


def test_a_missing_matplotlib_is_found_before_the_call(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "cab_forecast.plot", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib.axes", None)
    result = run(app, ["predict", "demo", "--plot", "out.png"])
    assert result.exit_code == 1
    assert result.stderr == 'error: plots need matplotlib: pip install "cab-forecast[plot]"\n'
    assert not script.calls


def fails_with_one_line(*arguments: str) -> str:
    """Return the single line on standard error of a failing command."""
    result = run(app, ["predict", *arguments])
    assert result.exit_code == 1
    assert not result.stdout
    line, end = result.stderr.split("\n")
    assert not end
    return line


def test_no_server() -> None:
    endpoint = f"http://127.0.0.1:{free_port()}"
    line = fails_with_one_line("demo", "--endpoint", endpoint)
    assert line.startswith(f"error: no connection to {endpoint}")
    assert line.endswith("start one with: cab-forecast serve)")


def test_errors_of_the_server(script: Script) -> None:
    script.failures = [
        Failure("INVALID_ARGUMENT", 422, "BAD_FIELD", "bad", violations=(("time", "is in\n1970"),))
    ]
    assert fails_with_one_line("demo") == "error: bad; time: is in 1970"
    script.failures = [Failure("UNAUTHENTICATED", 401, "UNAUTHENTICATED", "no token")]
    assert "--token" in fails_with_one_line("demo")


def test_files_that_are_none(tmp_path: Path) -> None:
    assert "No such file" in fails_with_one_line(str(tmp_path / "x.json"))
    for name, content in (("a.json", b"{"), ("b.binpb", b"\xff\xff"), ("c", b"{]"), ("d.json", b"\xff")):
        (tmp_path / name).write_bytes(content)
        assert f"{name} holds no PredictRequest" in fails_with_one_line(str(tmp_path / name))
    assert "No such file" in fails_with_one_line("demo", "--output", str(tmp_path / "no" / "x.json"))


def test_bad_arguments() -> None:
    assert "unknown scheme" in fails_with_one_line("demo", "--endpoint", "ftp://x")
    assert "timeout" in fails_with_one_line("demo", "--timeout", "0")
    assert run(app, ["predict", "demo", "--samples", "-1"]).exit_code == 2
