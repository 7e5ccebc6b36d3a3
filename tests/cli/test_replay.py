"""``cab-forecast replay`` against a fake server."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cab.forecast.v1.prediction_service_pb2 import PredictResponse
from cab_forecast import demo_request
from cli.main import app
from service.recording.call import AnsweredCall
from tests.cab_forecast.answers import answer
from tests.cab_forecast.fakes import Failure, Script, grpc_fake
from tests.service.recording.calls import folder_at

AGENTS = len(demo_request().agents)

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


def record(path: Path, *responses: PredictResponse) -> str:
    """Return a recording of calls of the demo that were answered so."""
    folder = folder_at(path)
    for response in responses:
        folder.write(AnsweredCall(demo_request(), response, None, {}, 1))
    folder.finish()
    [file] = path.glob("*.mcap")
    return str(file)


def shifted(meters: float) -> PredictResponse:
    """Return the answer to the demo, shifted."""
    response = answer(demo_request())
    for forecast in response.forecasts:
        forecast.means[:] = [value + meters for value in forecast.means]
    return response


def test_equal_answers_end_with_zero(tmp_path: Path, script: Script) -> None:
    file = record(tmp_path, shifted(0.0), shifted(0.0))
    result = run(app, ["replay", file])
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith(
        f"2 calls, {2 * AGENTS} forecasts: 0 calls differ by more than 0.0001; at most 0 m"
    )
    assert [request.model for request in script.predicted] == ["fan@1.0.0"] * 2
    assert run(app, ["replay", file, "--limit", "1", "--model", "kalman"]).exit_code == 0
    assert [request.model for request in script.predicted[2:]] == ["kalman"]


def test_differences_are_listed_and_end_with_one(tmp_path: Path) -> None:
    file = record(tmp_path, shifted(0.0), shifted(3.0))
    result = run(app, ["replay", file])
    assert result.exit_code == 1
    first, last = result.stdout.splitlines()
    assert first.startswith("call 2: time ")
    assert "positions 4.24 m" in first
    assert "1 calls differ" in last
    assert run(app, ["replay", file, "--tolerance", "5"]).exit_code == 0


def test_json_has_a_line_for_each_call(tmp_path: Path) -> None:
    result = run(app, ["replay", record(tmp_path, shifted(0.0), shifted(3.0)), "--json"])
    assert result.exit_code == 1
    calls = [json.loads(line) for line in result.stdout.splitlines()]
    assert [call["position_m"] for call in calls] == [0.0, pytest.approx(18**0.5)]
    assert calls[0]["agents"] == AGENTS


def test_a_refused_call_is_a_difference(tmp_path: Path, script: Script) -> None:
    script.failures.append(Failure("INVALID_ARGUMENT", 422, "BAD_FIELD", "not so"))
    result = run(app, ["replay", record(tmp_path, shifted(0.0), shifted(0.0))])
    assert result.exit_code == 1
    assert "not so" in result.stdout.splitlines()[0]
    assert f"2 calls, {AGENTS} forecasts" in result.stdout


def test_faults_are_said_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = tmp_path / "other.mcap"
    other.write_bytes(b"something else")
    for file, message in ((other, "is no recording"), (tmp_path / "none.mcap", "No such file")):
        result = run(app, ["replay", str(file)])
        assert result.exit_code == 1
        assert message in result.stderr
        assert result.stderr.count("\n") == 1
    monkeypatch.delitem(sys.modules, "cab_forecast.recordings", raising=False)
    monkeypatch.setitem(sys.modules, "mcap.stream_reader", None)
    result = run(app, ["replay", str(other)])
    assert result.stderr == 'error: recordings need mcap: pip install "cab-forecast[record]"\n'
