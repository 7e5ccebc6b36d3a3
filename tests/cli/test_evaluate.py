"""``cab-forecast evaluate`` on made-up scenes."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cli.main import app
from model.data.sources import READERS
from tests.model.data.records import FixedReader, record
from tests.model.evaluation.builders import PAPER_VERSION, checkpoints, save

PAIRS = len(record().pairs)


@pytest.fixture(autouse=True)
def made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Provide data of the kind "made" with the split "some"."""
    monkeypatch.setitem(READERS, "made", lambda path: FixedReader(record()))


def evaluate(
    folder: Path, *arguments: str, data: str = "made:DIR", split: str = "some"
) -> tuple[int, str, str]:
    """Return the exit code, standard output, and standard error on one line."""
    result = CliRunner().invoke(
        app, ["evaluate", "--data", data, "--split", split, "--out", str(folder / "out"), *arguments]
    )
    return result.exit_code, result.stdout, " ".join(result.stderr.split())


def test_all_models_are_judged_written_and_shown(tmp_path: Path) -> None:
    models = checkpoints(tmp_path / "models")
    arguments = ("--models", str(models), "--ablate", "--samples", "5")
    code, shown, errors = evaluate(tmp_path, *arguments)
    assert code == 0, errors
    text = (tmp_path / "out/results.json").read_text()
    results = json.loads(text)
    assert (results["pairs"], results["samples"], results["protocol"]) == (PAIRS, 5, "causal")
    rows = {row["name"]: row for row in results["rows"]}
    assert list(rows)[-3:] == ["physics-oracle", "cab", "trajectron-no-context"]
    assert {"ade_f_6s_m", "inside_90", "off_road_f", "nll", "miss_rate_5"} <= rows["cab"]["metrics"].keys()
    assert rows["cab"]["ablated"].keys() == {"map", "neighbors", "both"}
    assert rows["trajectron-no-context"]["ablated"] == {}
    tables = (tmp_path / "out/tables.md").read_text()
    for word in ("causal protocol", "split some", f"{PAIRS} pairs", "5 sampled", "Context ablation"):
        assert word in tables
        assert word in shown
    # Again, from the cache: bit-equal
    assert evaluate(tmp_path, *arguments)[0] == 0
    assert (tmp_path / "out/results.json").read_text() == text


def test_the_paper_protocol_takes_its_own_checkpoints(tmp_path: Path) -> None:
    models = checkpoints(tmp_path / "models")
    arguments = ("--models", str(models), "--protocol", "paper", "--samples", "0", "--limit", "6")
    assert evaluate(tmp_path, *arguments)[0] == 0
    results = json.loads((tmp_path / "out/results.json").read_text())
    assert (results["pairs"], results["limit"], results["rows"][-1]["version"]) == (6, 6, PAPER_VERSION)
    assert "ade_f_6s_m" not in results["rows"][-1]["metrics"]
    assert "the first 6 pairs only" in (tmp_path / "out/tables.md").read_text()


def test_the_bundled_checkpoints_are_the_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    models = checkpoints(tmp_path / "models")
    monkeypatch.setattr("service.settings.bundled_models", lambda: models)
    assert evaluate(tmp_path, "--only", "cab, kalman", "--samples", "0", "--limit", "3")[0] == 0
    rows = json.loads((tmp_path / "out/results.json").read_text())["rows"]
    assert [row["name"] for row in rows] == ["kalman", "cab"]
    monkeypatch.setattr("service.settings.bundled_models", lambda: None)
    assert evaluate(tmp_path)[0] == 1


def test_what_is_wrong_is_said_in_one_line(tmp_path: Path) -> None:
    save(tmp_path / "models/cab", "cab")
    models = ("--models", str(tmp_path / "models"))
    for arguments, changes, message in (
        (("--models", str(tmp_path / "nowhere")), {}, "nowhere: there is no such folder of checkpoints"),
        ((*models, "--protocol", "paper"), {}, "there is no checkpoint of the paper protocol"),
        ((*models, "--protocol", "best"), {}, "there is no protocol 'best'; there are causal, paper"),
        ((*models, "--only", "cab,nobody"), {}, "there is no model 'nobody' of the causal protocol"),
        ((*models, "--only", ","), {}, "only: it names nothing"),
        (models, {"split": "test"}, "there is no split 'test'; there are some, none"),
        (models, {"split": "none"}, "the split 'none' has no pairs"),
        (models, {"data": "nowhere"}, "'nowhere' is not KIND:PATH"),
        ((*models, "--only", "kalman"), {"split": "none"}, "the split 'none' has no pairs"),
    ):
        code, shown, errors = evaluate(tmp_path, *arguments, **changes)
        assert (code, shown) == (1, ""), message
        assert message in errors
        assert "Traceback" not in errors
    assert not (tmp_path / "out/results.json").exists()


def test_usage(tmp_path: Path) -> None:
    assert evaluate(tmp_path, "--limit", "0")[0] == 2
    assert evaluate(tmp_path, "--samples", "-1")[0] == 2
