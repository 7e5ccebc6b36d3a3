"""The loop: learns, resumes exactly, keeps the best."""

from pathlib import Path

import pytest
import torch

from model.cvae import CvaeNetworks
from model.forecaster import Context
from model.scene import AgentType
from model.training.config import Method, TrainingConfig, TrainingError, load_config
from model.training.loop import SCORE, Trainer
from model.training.state import Progress
from tests.model.training.fakes import MadeUpPairs, small_config

PAIRS = MadeUpPairs(48)


def validate(networks: CvaeNetworks) -> dict[str, float]:
    """FDE of the likeliest mode on the training pairs."""
    features, future = PAIRS.batch(torch.arange(len(PAIRS)))
    with torch.no_grad():
        log_weights, positions = networks.of(AgentType.VEHICLE)(features, Context.FULL, 12)
    best = positions.mean[torch.arange(len(PAIRS)), log_weights.argmax(1)]
    return {SCORE: (best - future)[:, -1].norm(dim=-1).mean().item()}


def train(config: TrainingConfig, folder: Path) -> tuple[Trainer, list[dict[str, float]]]:
    """Runs to the end; the figures of each epoch."""
    reports: list[dict[str, float]] = []
    trainer = Trainer(config, PAIRS, validate, folder, torch.device("cpu"))

    def report(progress: Progress, figures: dict[str, float]) -> None:
        reports.append(figures)

    trainer.run(report, lambda done, batches: None)
    return trainer, reports


@pytest.mark.parametrize("method", list(Method))
def test_every_method_learns(tmp_path: Path, method: Method) -> None:
    _, reports = train(small_config(method, epochs=8), tmp_path)
    likelihood = "log_likelihood" if "log_likelihood" in reports[0] else "log_likelihood_full"
    assert reports[-1][likelihood] > reports[0][likelihood] + 5
    assert all(torch.isfinite(torch.tensor(list(figures.values()))).all() for figures in reports)


def test_a_run_in_two_parts_is_the_same_as_in_one(tmp_path: Path) -> None:
    whole, _ = train(small_config(epochs=4), tmp_path / "whole")
    train(small_config(epochs=2), tmp_path / "parts")
    parts, reports = train(small_config(epochs=4), tmp_path / "parts")
    assert len(reports) == 2
    assert parts.progress.step == whole.progress.step
    assert parts.progress.best_score == whole.progress.best_score
    for (name, a), (_, b) in zip(
        whole.networks.state_dict().items(), parts.networks.state_dict().items(), strict=True
    ):
        assert torch.equal(a, b), name


def test_the_best_epoch_is_kept(tmp_path: Path) -> None:
    scores = iter([3.0, 1.0, 2.0])
    trainer = Trainer(
        small_config(epochs=3), PAIRS, lambda _: {SCORE: next(scores)}, tmp_path, torch.device("cpu")
    )
    kept: list[torch.Tensor] = []
    name = "vehicle.full.decoder.mean.weight"
    trainer.run(
        lambda *_: kept.append(trainer.networks.state_dict()[name].clone()), lambda done, batches: None
    )
    assert trainer.progress.best_epoch == 2
    assert trainer.progress.best_score == 1.0
    assert torch.equal(trainer.best()[name], kept[1])


def test_a_run_with_other_settings_is_not_resumed(tmp_path: Path) -> None:
    train(small_config(epochs=1), tmp_path)
    with pytest.raises(TrainingError, match="other settings: learning_rate"):
        train(small_config(epochs=2, learning_rate=0.1), tmp_path)


def test_a_damaged_state_is_named(tmp_path: Path) -> None:
    train(small_config(epochs=1), tmp_path)
    (tmp_path / "state.json").write_text("{")
    with pytest.raises(TrainingError, match=r"state\.json: cannot be resumed"):
        train(small_config(epochs=2), tmp_path)


@pytest.mark.parametrize("method", list(Method))
def test_every_method_has_its_settings(method: Method) -> None:
    config = load_config(method)
    assert config.method is method
    assert load_config(method, learning_rate=0.0003).learning_rate == 0.0003


def test_wrong_settings_are_named(tmp_path: Path) -> None:
    file = tmp_path / "x.toml"
    file.write_text("learning_rate = -1\nnot_there = 3\n")
    with pytest.raises(TrainingError, match="learning_rate"):
        load_config(Method.CAB, file)
    with pytest.raises(TrainingError, match="cannot be read"):
        load_config(Method.CAB, tmp_path / "nowhere.toml")
