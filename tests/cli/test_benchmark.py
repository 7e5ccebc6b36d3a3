"""``cab-forecast benchmark`` as a user runs it, against a real server."""

import json
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from benchmark.archive import FILE
from benchmark.prometheus_rules import RULES_FILE
from cli.main import app
from model.data.sources import READERS, parse_data
from service.server import Server
from tests.benchmark.scenes import PAIRS, READER, RECORDS, write_nuscenes_pred
from tests.model.evaluation.builders import checkpoints
from tests.service.servers import in_thread, settings

MODELS = "cab,kalman"
ATTEMPTS = 5
DEADLINE = 120.0


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Write a data set in the layout nuscenes_pred."""
    return f"nuscenes_pred:{write_nuscenes_pred(tmp_path_factory.mktemp('data'))}"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Serve two learned models and the baselines."""
    folder = checkpoints(tmp_path_factory.mktemp("models"))
    with in_thread(settings(models=folder, default_model="kalman")) as running:
        yield running


def run(*arguments: str) -> tuple[int, str, str]:
    """Return the exit code, standard output, and standard error on one line."""
    result = CliRunner().invoke(app, ["benchmark", *arguments])
    return result.exit_code, result.stdout, " ".join(result.stderr.split())


def results(folder: Path) -> dict[str, Any]:
    """Read the results, without the measured latencies."""
    read: dict[str, Any] = json.loads((folder / "results.json").read_text())
    for model in read["models"]:
        del model["latency"]
    return read


def test_the_tables_of_a_run_and_of_its_saved_answers(tmp_path: Path, data: str, server: Server) -> None:
    out = tmp_path / "run"
    asked = ("--endpoint", f"grpc://{server.grpc_address}", "--samples", "5", "--processes", "1")
    code, shown, said = run("--data", data, "--out", str(out), *asked)
    assert code == 0, said
    for file in ("results.json", "tables.md", "report.html", "instances.npz", RULES_FILE, FILE):
        assert (out / file).stat().st_size > 0, file
    assert not list(out.glob("submission-*"))  # this data has no tokens
    for text in ("physics-oracle", "kalman", "causal protocol, nuscenes_pred split train_val"):
        assert text in shown
        assert text in (out / "tables.md").read_text()
    assert "requested" in said
    assert len(results(out)["models"]) == 8
    # Again from the saved responses, without an endpoint, into another folder
    code, _, said = run(
        "--data",
        data,
        "--from",
        str(out),
        "--out",
        str(tmp_path / "again"),
        "--samples",
        "5",
        "--processes",
        "1",
    )
    assert code == 0, said
    assert "requested" not in said
    assert results(tmp_path / "again") == results(out)
    code, compared, said = run("compare", str(out), str(tmp_path / "again"))
    assert code == 0, said
    assert "kalman" in compared
    code, compared, said = run("seeds", *MODELS.split(","), str(out), str(tmp_path / "again"))
    assert code == 0, said
    assert "over 2 and 2 trainings" in compared


def test_a_run_that_was_killed_goes_on_to_the_same_result(tmp_path: Path, data: str, server: Server) -> None:
    whole = tmp_path / "whole"
    arguments = ["--data", data, "--endpoint", f"http://{server.http_address}", "--samples", "5"]
    arguments += ["--models", MODELS, "--processes", "1", "--concurrency", "1"]
    wanted = 2 * 10  # calls, of some 90
    # On a busy machine a run may be through before it can be killed
    folders = (tmp_path / f"killed-{attempt}" for attempt in range(ATTEMPTS))
    killed = next(folder for folder in folders if kill_after(wanted, folder, arguments))
    had = rows(killed)
    assert wanted <= len(had)
    assert not (killed / "results.json").exists()
    assert run(*arguments, "--out", str(killed))[0] == 0
    assert run(*arguments, "--out", str(whole))[0] == 0
    after = rows(killed)
    assert had.items() <= after.items()  # not requested again: the durations are the old ones
    assert after.keys() == rows(whole).keys()
    assert len(after) > len(had)
    assert results(killed) == results(whole)


def kill_after(wanted: int, folder: Path, arguments: list[str]) -> bool:
    """Start a run and kill it once so many responses are saved; return False if it was through before."""
    command = [sys.executable, "-m", "service", "benchmark", *arguments, "--out", str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # noqa: S603
    deadline = time.monotonic() + DEADLINE
    while answered(folder) < wanted:
        assert time.monotonic() < deadline
        if process.poll() is not None:
            assert process.returncode == 0
            return False
        time.sleep(0.01)
    process.kill()
    return process.wait() == -signal.SIGKILL


def rows(folder: Path) -> dict[tuple[str, str, int], float]:
    """Return the duration of every saved response, s."""
    file = sqlite3.connect(folder / FILE)
    try:
        found = file.execute("SELECT model, scene, frame, seconds FROM answers").fetchall()
    finally:
        file.close()
    return {(model, scene, frame): seconds for model, scene, frame, seconds in found}


def answered(folder: Path) -> int:
    """Return the number of saved responses."""
    try:
        return len(rows(folder)) if (folder / FILE).exists() else 0
    except sqlite3.OperationalError:  # its tables do not exist yet
        return 0


def test_missing_forecasts_end_in_an_error(tmp_path: Path, data: str) -> None:
    """A server with a limit below a frame's number of agents rejects its request."""
    tight = settings(models=tmp_path / "none", default_model="kalman", max_agents=3)
    (tmp_path / "none").mkdir()
    with in_thread(tight) as server:
        code, shown, said = run(
            *("--data", data, "--out", str(tmp_path / "run"), "--models", "kalman", "--samples", "0"),
            *("--endpoint", f"grpc://{server.grpc_address}", "--processes", "1"),
        )
    assert code == 1
    assert "forecasts are missing: the metrics leave them out" in said
    assert "refused: kalman@1.0.0, scene-1, frame" in said
    assert "kalman" in shown
    missing = results(tmp_path / "run")["models"][0]["statuses"]["MISSING"]
    assert 0 < missing < PAIRS


def test_data_with_tokens_gives_submissions_of_who_answered_it_all(
    tmp_path: Path, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(READERS, "made", lambda path: READER)
    arguments = ["--data", "made:here", "--split", "some", "--models", MODELS, "--samples", "0"]
    arguments += ["--processes", "1", "--endpoint", f"grpc://{server.grpc_address}"]
    out = tmp_path / "run"
    assert run(*arguments, "--out", str(out))[0] == 0
    assert {file.name for file in out.glob("submission-*")} == {
        "submission-cab@1.0.0.json",
        "submission-kalman@1.0.0.json",
    }
    assert len(json.loads((out / "submission-cab@1.0.0.json").read_text())) == PAIRS
    file = sqlite3.connect(out / FILE)
    with file:
        file.execute("DELETE FROM answers WHERE model = 'cab@1.0.0' AND scene = 'scene-2' AND frame = 8")
    file.close()
    again = tmp_path / "again"
    code, shown, said = run(*arguments[:8], "--processes", "1", "--from", str(out), "--out", str(again))
    assert code == 1
    assert "no submission of cab@1.0.0: " in said
    assert "forecasts are missing" in said
    assert [one.name for one in again.glob("submission-*")] == ["submission-kalman@1.0.0.json"]
    assert (again / "report.html").is_file()
    assert "8. Forecast statuses" in shown


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "--data and --out are needed"),
        (("--data", "nowhere", "--out", "{out}"), "data: 'nowhere' is not KIND:PATH"),
        (("--data", "{data}", "--out", "{out}", "--models", " ,"), "models: it names nothing"),
        (("--data", "{data}", "--out", "{out}", "--protocol", "best"), "no protocol 'best'"),
        (("--data", "{data}", "--out", "{out}", "--split", "val"), "no split 'val'"),
        (("--data", "{data}", "--out", "{out}", "--models", "fan"), "the endpoint has no model 'fan'"),
        (("--data", "{data}", "--out", "{out}", "--endpoint", "127.0.0.1:1"), "the endpoint does not answer"),
        (("--data", "{data}", "--from", "{empty}"), "there are no saved answers"),
        (("compare", "{empty}", "{empty}"), "results.json"),
        (("seeds", "kalman", "cab", "{empty}"), "results.json"),
        (
            ("--data", "{data}", "--out", "{out}", "--models", "kalman", "--context"),
            "the measures of the context need forecasts of 'trajectron-no-context': ask it, too",
        ),
    ],
)
def test_what_cannot_be_done_is_said(
    tmp_path: Path, data: str, server: Server, arguments: tuple[str, ...], said: str
) -> None:
    (tmp_path / "empty").mkdir()
    places = {"data": data, "out": str(tmp_path / "out"), "empty": str(tmp_path / "empty")}
    given = [argument.format(**places) for argument in arguments]
    if "--endpoint" not in given and given and given[0] not in ("compare", "seeds"):
        given += ["--endpoint", f"grpc://{server.grpc_address}"]
    if given and given[0] not in ("compare", "seeds"):
        given += ["--timeout", "1"]
    code, shown, errors = run(*given)
    assert code == 1
    assert said in errors
    assert "Traceback" not in errors + shown


def test_the_use_of_the_context(tmp_path: Path, data: str, server: Server) -> None:
    asked = ("--data", data, "--out", str(tmp_path), "--endpoint", f"grpc://{server.grpc_address}")
    fast = ("--no-consistency", "--samples", "0", "--processes", "1", "--models", MODELS)
    context = ("--context", "--donors", "1", "--no-context-model", "kalman@1.0.0")
    code, shown, said = run(*asked, *fast, *context)
    assert code == 0, said
    assert "9. Use of the context" in shown
    assert "forecasts with a changed context in" in said
    read = results(tmp_path)
    assert (read["context"]["no_context"], read["context"]["donors"]) == ("kalman@1.0.0", 1)
    assert read["models"][0]["context"]["all"]["gain_m"]["pairs"] == PAIRS


def test_the_data_on_disk_is_the_one_in_memory(data: str) -> None:
    """The layout has vehicles only."""
    kind, path = parse_data(data)
    read = list(READERS[kind](path).scenes("train_val"))
    assert [(one.name, len(one.pairs)) for one in read] == [(one.name, len(one.pairs)) for one in RECORDS]
    assert (read[0].raster.layers == RECORDS[0].raster.layers).all()
    assert (read[0].tracks[0].position == RECORDS[0].tracks[0].position).all()
