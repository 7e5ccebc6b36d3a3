"""``cab-forecast train`` on a made-up scene."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from cli.main import app
from cli.train import Estimate
from model.checkpoint import load_checkpoint
from model.data.sources import READERS
from model.training.config import Method
from tests.model.data.records import FixedReader, record
from tests.model.training.fakes import small_config


@pytest.fixture(autouse=True)
def made(monkeypatch: pytest.MonkeyPatch) -> None:
    """Provide data of the kind "made" with the split "some"."""
    monkeypatch.setitem(READERS, "made", lambda path: FixedReader(record()))


@pytest.fixture
def settings(tmp_path: Path) -> Path:
    """Write the settings of a small network, with a table of published values."""
    file = tmp_path / "settings.toml"
    text = small_config(Method.TRAJECTRON, epochs=1, displacement_weight=1.0).toml()
    file.write_text(f"{text}\n[published]\nlearning_rate = 0.0025\nbatch_size = 8\nepochs = 1\n")
    return file


def train(folder: Path, method: str, *arguments: str, data: str = "made:DIR") -> tuple[int, str, str]:
    """Return the exit code, standard output, and standard error on one line."""
    splits = ("--train-split", "some", "--validation-split", "some")
    result = CliRunner().invoke(
        app, ["train", method, "--data", data, "--out", str(folder / "out"), *splits, *arguments]
    )
    return result.exit_code, result.stdout, " ".join(result.stderr.split())


def state(folder: Path) -> dict[str, Any]:
    """Read the settings and progress of a run."""
    read: dict[str, Any] = json.loads((folder / "out/state.json").read_text())
    return read


def test_a_run_its_checkpoint_and_one_that_begins_with_it(tmp_path: Path, settings: Path) -> None:
    code, shown, said = train(tmp_path, "trajectron", "--config", str(settings), "--version", "1.2.3")
    assert code == 0, said
    folder = tmp_path / "out/checkpoint"
    assert str(folder) in "".join((shown + said).split())
    assert load_checkpoint(folder).info.full_name == "trajectron@1.2.3"
    assert state(tmp_path)["config"]["displacement_weight"] == 1
    # More epochs: the run resumes
    code, _, said = train(tmp_path, "trajectron", "--config", str(settings), "--epochs", "2")
    assert code == 0, said
    assert state(tmp_path)["progress"]["epoch"] == 2
    next_one = tmp_path / "next"
    begin = ("--init-from", str(folder), "--seed", "5")
    code, _, said = train(next_one, "trajectron", "--config", str(settings), *begin)
    assert code == 0, said
    config = state(next_one)["config"]
    assert config["start"] == "trajectron@1.0.0 (causal)"
    assert config["seed"] == 5


@pytest.mark.parametrize(
    ("name", "alias", "value", "wrong"),
    [
        ("--init-from", "--start", "{folder}/nothing", "nothing"),
        ("--extra-data", "--also", "nowhere", "nowhere"),
    ],
)
def test_an_option_keeps_its_old_name(
    tmp_path: Path, settings: Path, name: str, alias: str, value: str, wrong: str
) -> None:
    given = value.format(folder=tmp_path)
    new, old = (
        train(tmp_path, "trajectron", "--config", str(settings), each, given) for each in (name, alias)
    )
    assert new == old
    assert new[0] == 1
    assert wrong in new[2]


def test_as_published(tmp_path: Path, settings: Path) -> None:
    code, _, said = train(tmp_path, "trajectron", "--config", str(settings), "--published")
    assert code == 0, said
    config = state(tmp_path)["config"]
    assert (config["learning_rate"], config["kl_weight"], config["displacement_weight"]) == (0.0025, 100, 0)


@pytest.mark.parametrize(
    ("method", "arguments", "data", "wrong"),
    [
        ("trajectory", (), "made:DIR", "there is no method 'trajectory'; there are cab, trajectron"),
        ("cab", (), "made", "made"),
        ("cab", (), "other:DIR", "other"),
        ("cab", ("--protocol", "acausal"), "made:DIR", "acausal"),
        ("cab", ("--train-split", "none"), "made:DIR", "none"),
        ("cab", ("--start", "{folder}/nothing"), "made:DIR", "nothing"),
        ("cab", ("--config", "{folder}/nothing.toml"), "made:DIR", "nothing.toml: cannot be read"),
        ("cab", ("--config", "{settings}"), "made:DIR", "blind is none, but cab trains a blind forecast"),
        ("trajectron", ("--config", "{settings}", "--learning-rate", "1e6"), "made:DIR", "has diverged"),
    ],
)
def test_what_cannot_be_trained_is_said(
    tmp_path: Path, settings: Path, method: str, arguments: tuple[str, ...], data: str, wrong: str
) -> None:
    given = [one.format(folder=tmp_path, settings=settings) for one in arguments]
    code, _, said = train(tmp_path, method, *given, data=data)
    assert code == 1
    assert wrong in said
    assert "Traceback" not in said
    assert not (tmp_path / "out/checkpoint").exists()


def test_the_first_step_and_an_estimate_are_told(tmp_path: Path, settings: Path) -> None:
    code, shown, said = train(tmp_path, "trajectron", "--config", str(settings))
    assert code == 0, said
    assert "trajectron: reading the data" in shown
    assert "The cache of some does not exist yet" in shown
    assert "first step of epoch 1 done" in shown


def test_the_estimate_comes_after_some_steps() -> None:
    said: list[str] = []
    seconds = iter([10.0, 12.0, 14.5])
    estimate = Estimate(3, said.append, clock=lambda: next(seconds))
    for done in range(1, 6):
        estimate.step(1, done, 100)
    assert said == [
        "first step of epoch 1 done, of 100 steps in each of 3 epochs",
        "2.2 s a step: 4 min an epoch and 11 min to the end, without the validation after each epoch",
    ]


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("model.training.run.open_cache", "interrupted before the first step: run the same command again"),
        ("model.training.loop.save_state", "interrupted in epoch 1: run the same command again to resume"),
    ],
)
def test_ctrl_c_ends_with_a_plain_word(
    tmp_path: Path, settings: Path, monkeypatch: pytest.MonkeyPatch, place: str, told: str
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(place, interrupt)
        code, shown, said = train(tmp_path, "trajectron", "--config", str(settings))
    assert code == 130
    assert told in shown
    assert "Traceback" not in said
    code, _, said = train(tmp_path, "trajectron", "--config", str(settings))
    assert code == 0, said
