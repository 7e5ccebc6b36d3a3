"""The loop: learns, resumes exactly, keeps the best."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from pydantic import ValidationError
from torch import Tensor, nn

from model.forecaster import Context
from model.networks.config import NetworkConfig
from model.networks.covernet import CoverNet
from model.networks.forecaster import CvaeNetworks, Networks
from model.scenes.scene import AgentType
from model.training.config import Method, TrainingConfig, TrainingError, load_config
from model.training.learner import Batch, scale_dropout
from model.training.loop import SCORE, Trainer
from model.training.objectives import LossWeights
from model.training.sampling import epoch_order
from model.training.state import Progress
from tests.model.training.fakes import MadeUpPairs, small_config

PAIRS = MadeUpPairs(48)


def validate(networks: Networks[Any]) -> dict[str, float]:
    """Return the FDE of the likeliest mode on the training pairs."""
    features, future = PAIRS.batch(torch.arange(len(PAIRS)))
    with torch.no_grad():
        log_weights, positions = networks.of(AgentType.VEHICLE)(features, Context.FULL, 12)
    best = positions.mean[torch.arange(len(PAIRS)), log_weights.argmax(1)]
    return {SCORE: (best - future)[:, -1].norm(dim=-1).mean().item()}


def train(config: TrainingConfig, folder: Path) -> tuple[Trainer, list[dict[str, float]]]:
    """Run to the end; return the trainer and the figures of each epoch."""
    reports: list[dict[str, float]] = []
    trainer = Trainer(config, PAIRS, validate, folder, torch.device("cpu"))

    def report(progress: Progress, figures: dict[str, float]) -> None:
        reports.append(figures)

    trainer.run(report, lambda done, batches: None)
    return trainer, reports


@pytest.mark.parametrize("method", list(Method))
def test_every_method_learns(tmp_path: Path, method: Method) -> None:
    _, reports = train(small_config(method, epochs=8), tmp_path)
    first, last = reports[0], reports[-1]
    if method is Method.COVERNET:
        assert last["loss"] < first["loss"] - 0.5
        assert last["top_5"] > first["top_5"]
    else:
        likelihood = "log_likelihood" if "log_likelihood" in first else "log_likelihood_full"
        assert last[likelihood] > first[likelihood] + 5
    assert all(torch.isfinite(torch.tensor(list(figures.values()))).all() for figures in reports)


@pytest.mark.parametrize("method", [Method.CAB, Method.COVERNET, Method.HALENTNET])
def test_a_run_in_two_parts_is_the_same_as_in_one(tmp_path: Path, method: Method) -> None:
    mirror = method is not Method.COVERNET
    whole, _ = train(small_config(method, epochs=2, mirror=mirror), tmp_path / "whole")
    train(small_config(method, epochs=1, mirror=mirror), tmp_path / "parts")
    parts, reports = train(small_config(method, epochs=2, mirror=mirror), tmp_path / "parts")
    assert len(reports) == 1
    assert parts.progress.step == whole.progress.step
    assert parts.progress.best_score == whole.progress.best_score
    for module, networks in whole.learner.modules().items():
        other = parts.learner.modules()[module].state_dict()
        for name, tensor in networks.state_dict().items():
            assert torch.equal(tensor, other[name]), (module, name)


def test_with_averaging_the_running_mean_is_judged_and_kept(tmp_path: Path) -> None:
    config = small_config(Method.TRAJECTRON, epochs=1, ema_decay=0.5)
    judged: list[dict[str, Tensor]] = []
    steps: list[dict[str, Tensor]] = []

    def note(networks: Networks[Any]) -> dict[str, float]:
        judged.append({n: p.detach().clone() for n, p in networks.named_parameters()})
        return validate(networks)

    trainer = Trainer(config, PAIRS, note, tmp_path, torch.device("cpu"))

    def tick(done: int, batches: int) -> None:
        steps.append({n: p.detach().clone() for n, p in trainer.networks.named_parameters()})

    trainer.run(lambda progress, figures: None, tick)
    mean = steps[0]
    for after in steps[1:]:
        mean = {name: 0.5 * tensor + 0.5 * after[name] for name, tensor in mean.items()}
    assert len(steps) > 1
    best = trainer.best()
    for name, tensor in mean.items():
        torch.testing.assert_close(judged[0][name], tensor)
        assert torch.equal(best[name], judged[0][name])
    assert any(not torch.equal(steps[-1][name], mean[name]) for name in mean)


def test_the_running_mean_is_resumed_exactly(tmp_path: Path) -> None:
    def config(epochs: int) -> TrainingConfig:
        return small_config(Method.TRAJECTRON, epochs=epochs, ema_decay=0.9)

    whole, _ = train(config(2), tmp_path / "whole")
    train(config(1), tmp_path / "parts")
    parts, _ = train(config(2), tmp_path / "parts")
    assert parts.progress.best_score == whole.progress.best_score
    assert all(torch.equal(tensor, parts.best()[name]) for name, tensor in whole.best().items())


@pytest.mark.parametrize("method", [Method.CAB, Method.RUBIZ, Method.HALENTNET, Method.COVERNET])
@pytest.mark.parametrize("factor", [0.0, 0.5])
def test_dropout_is_scaled_in_every_method(tmp_path: Path, method: Method, factor: float) -> None:
    def rates(config: TrainingConfig) -> list[float]:
        trainer = Trainer(config, PAIRS, validate, tmp_path, torch.device("cpu"))
        return [module.p for module in trainer.networks.modules() if isinstance(module, nn.Dropout)]

    released = rates(small_config(method))
    assert released
    assert min(released) > 0
    scaled = rates(small_config(method, dropout_factor=factor))
    assert scaled == [rate * factor for rate in released]


@pytest.mark.parametrize("method", [Method.CAB, Method.COVERNET])
def test_the_displacement_may_come_later(tmp_path: Path, method: Method) -> None:
    _, reports = train(
        small_config(method, epochs=2, displacement_weight=1.0, displacement_warmup_epochs=1), tmp_path
    )
    without, with_it = ({name for name in each if name.startswith("displacement")} for each in reports)
    assert not without
    assert with_it
    assert reports[1]["loss"] > reports[0]["loss"]  # of some metres a step more


def test_covernet_is_not_mirrored() -> None:
    with pytest.raises(ValidationError, match="does not cover mirrored ones"):
        small_config(Method.COVERNET, mirror=True)


def test_without_dropout_a_step_is_the_same_each_time() -> None:
    networks = CvaeNetworks(NetworkConfig()).train()
    network, (given, _) = networks.of(AgentType.VEHICLE), PAIRS.batch(torch.arange(8))
    with torch.no_grad():
        assert not torch.equal(*(network.encode(given, Context.FULL) for _ in range(2)))
        scale_dropout(networks, 0.0)
        assert torch.equal(*(network.encode(given, Context.FULL) for _ in range(2)))


@pytest.mark.parametrize("asked", [False, True])
def test_about_half_of_the_agents_are_mirrored_if_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: bool
) -> None:
    config = small_config(Method.TRAJECTRON, epochs=1, mirror=asked, rotate=False)
    trainer = Trainer(config, PAIRS, validate, tmp_path, torch.device("cpu"))
    seen: list[Batch] = []
    step = trainer.learner.step

    def watch(batches: Sequence[Batch], weights: LossWeights, rate: float) -> dict[str, Tensor]:
        seen.extend(batches)
        return step(batches, weights, rate)

    monkeypatch.setattr(trainer.learner, "step", watch)
    trainer.run(lambda progress, figures: None, lambda done, batches: None)
    known, future = PAIRS.batch(epoch_order(PAIRS.turned, config.curved_oversampling, config.seed, epoch=0))
    got = torch.cat([batch.future for batch in seen])
    expected, velocity = future[: len(got)], known["velocity"][: len(got)]
    mirrored = (got[..., 1] == -expected[..., 1]).all(dim=1)
    kept = (got == expected).all(dim=2).all(dim=1)
    assert (mirrored ^ kept).all()
    assert 0.25 < mirrored.double().mean() < 0.75 if asked else kept.all()
    sides = torch.where(mirrored, -1.0, 1.0)
    assert torch.equal(
        torch.cat([batch.features["velocity"][:, 1] for batch in seen]), sides * velocity[:, 1]
    )


def test_those_who_stood_and_leave_are_shown_as_staying(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Leaving(MadeUpPairs):
        @property
        def leaving(self) -> Tensor:
            return torch.arange(len(self)) % 2 == 0

    config = small_config(
        Method.TRAJECTRON, epochs=1, leaving_keep_probability=0.0, mirror=False, rotate=False
    )
    pairs = Leaving(len(PAIRS))
    trainer = Trainer(config, pairs, validate, tmp_path, torch.device("cpu"))
    seen: list[Batch] = []

    def watch(batches: Sequence[Batch], weights: LossWeights, rate: float) -> dict[str, Tensor]:
        seen.extend(batches)
        return {}

    monkeypatch.setattr(trainer.learner, "step", watch)
    trainer.run(lambda progress, figures: None, lambda done, batches: None)
    order = epoch_order(pairs.turned, config.curved_oversampling, config.seed, epoch=0)
    got = torch.cat([batch.future for batch in seen])
    order = order[: len(got)]
    stays = (got == 0).flatten(1).all(dim=1)
    assert torch.equal(stays, pairs.leaving[order])
    assert torch.equal(got[~stays], pairs.batch(order)[1][~stays])


def test_a_run_begins_with_the_parameters_that_it_is_given(tmp_path: Path) -> None:
    first, _ = train(small_config(Method.TRAJECTRON, epochs=1), tmp_path / "first")
    given = dict(first.networks.state_dict())
    config = small_config(Method.CAB, epochs=1, start="trajectron@1.0.0 (causal)")
    begun = Trainer(config, PAIRS, validate, tmp_path / "second", torch.device("cpu"), given)
    assert all(torch.equal(t, given[name]) for name, t in begun.networks.state_dict().items())


def test_a_start_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    given = {"vehicle.full.decoder.mean.bias": torch.zeros(2)}
    with pytest.raises(TrainingError, match="fits 0% of the network's parameters"):
        Trainer(small_config(), PAIRS, validate, tmp_path, torch.device("cpu"), given)


def test_what_covernet_computes_from_the_data_stays_when_it_begins_with_another(tmp_path: Path) -> None:
    first, _ = train(small_config(Method.COVERNET, epochs=1), tmp_path / "first")
    given = {name: t + 1 for name, t in first.networks.state_dict().items()}
    begun = Trainer(
        small_config(Method.COVERNET), PAIRS, validate, tmp_path / "second", torch.device("cpu"), given
    )
    for name, tensor in first.networks.named_buffers():
        assert torch.equal(begun.networks.get_buffer(name), tensor)


def test_the_end_of_a_run_cools_and_its_length_is_then_fixed(tmp_path: Path) -> None:
    _, reports = train(small_config(epochs=2, cooldown_epochs=1), tmp_path)
    assert reports[0]["learning_rate"] == pytest.approx(0.003, rel=0.01)
    assert reports[1]["learning_rate"] == 0
    with pytest.raises(TrainingError, match="other settings: epochs"):
        train(small_config(epochs=4, cooldown_epochs=1), tmp_path)


def test_the_cover_of_covernet_is_of_the_training_paths(tmp_path: Path) -> None:
    trainer, _ = train(small_config(Method.COVERNET, epochs=1), tmp_path)
    network = trainer.networks.of(AgentType.VEHICLE)
    assert isinstance(network, CoverNet)
    assert network.config.members == len(network.trajectory_set) > network.config.modes
    same = (PAIRS.paths[:, None] == network.trajectory_set).all(dim=(2, 3))
    assert same.any(dim=0).all()
    farthest = (PAIRS.paths[:, None] - network.trajectory_set).norm(dim=-1).amax(dim=-1)
    assert farthest.amin(dim=1).amax() <= network.config.epsilon + 1e-4


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


def test_of_how_many_epochs_half_have_no_displacement_is_then_fixed(tmp_path: Path) -> None:
    def config(epochs: int, after: int = 2) -> TrainingConfig:
        return small_config(epochs=epochs, displacement_weight=1.0, displacement_warmup_epochs=after)

    assert [config(epochs).displacement_start for epochs in (1, 2, 3, 4, 9)] == [0, 1, 1, 2, 2]
    assert config(9).model_copy(update={"start": "cab@1.0.0 (causal)"}).displacement_start == 0
    train(config(2), tmp_path)
    with pytest.raises(TrainingError, match="other settings: epochs"):
        train(config(4), tmp_path)
    assert len(train(config(3), tmp_path)[1]) == 1


def test_settings_that_a_run_did_not_know_have_their_defaults(tmp_path: Path) -> None:
    train(small_config(epochs=1), tmp_path)
    file = tmp_path / "state.json"
    state = json.loads(file.read_text())
    del state["config"]["displacement_warmup_epochs"], state["config"]["network"]["max_control_sigma"]
    file.write_text(json.dumps(state))
    assert len(train(small_config(epochs=2), tmp_path)[1]) == 1
    state = json.loads(file.read_text())
    state["config"]["no_more"] = 1
    file.write_text(json.dumps(state))
    with pytest.raises(TrainingError, match="settings that no longer exist: no_more"):
        train(small_config(epochs=2), tmp_path)


def test_a_run_that_was_saved_with_the_old_names_of_its_settings_is_resumed(tmp_path: Path) -> None:
    def config(epochs: int, ema_decay: float = 0.9) -> TrainingConfig:
        return small_config(
            epochs=epochs, ema_decay=ema_decay, displacement_weight=1.0, displacement_warmup_epochs=1
        )

    whole, _ = train(config(3), tmp_path / "whole")
    train(config(2), tmp_path / "parts")
    file = tmp_path / "parts/state.json"
    state = json.loads(file.read_text())
    for old, new in (
        ("averaging", "ema_decay"),
        ("least_learning_rate", "min_learning_rate"),
        ("displacement_after", "displacement_warmup_epochs"),
        ("least_step_likelihood", "min_step_likelihood"),
        ("curved_copies", "curved_oversampling"),
        ("leaving_share", "leaving_keep_probability"),
        ("apart_weight", "blind_kl_weight"),
        ("hide", "context_dropout"),
        ("block", "stopped_vehicles"),
    ):
        state["config"][old] = state["config"].pop(new)
    state["config"]["mixture"]["nearest"] = state["config"]["mixture"].pop("min_ade")
    file.write_text(json.dumps(state))
    parts, reports = train(config(3), tmp_path / "parts")
    assert len(reports) == 1
    assert all(torch.equal(tensor, parts.best()[name]) for name, tensor in whole.best().items())
    state = json.loads(file.read_text())
    state["config"]["averaging"] = state["config"].pop("ema_decay")
    file.write_text(json.dumps(state))
    with pytest.raises(TrainingError, match="other settings: ema_decay"):
        train(config(4, ema_decay=0.8), tmp_path / "parts")


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


@pytest.mark.parametrize("method", list(Method))
def test_every_method_is_trained_as_published_on_request(method: Method) -> None:
    ours, published = load_config(method), load_config(method, published=True)
    changed = {name for name, value in published.network if value != getattr(ours.network, name)}
    assert ours.in_agent_frame
    assert changed == {"frame"} | ({"far_map"} if ours.network.uses_map else set())
    assert not published.in_agent_frame
    assert getattr(published.network, "max_control_sigma", None) is None
    assert (published.kl_weight, published.blind_kl_weight, published.epochs) == (100, 5, 40)
    assert published.displacement_weight == 0
    assert ours.displacement_weight > 0 or ours.mixture.expected_ade > 0
    assert published.rotate is (method is not Method.COVERNET)
    assert not ours.rotate
    assert load_config(method, published=True, epochs=3).epochs == 3
    changes = {"epochs", "cooldown_epochs", "ema_decay"}
    changes |= {"variants"} if method is Method.COVERNET else {"mixture", "variants"}
    assert {name for name, value in published if value != getattr(ours, name)} >= changes


def test_a_short_run_has_short_phases() -> None:
    late: dict[str, Any] = {"displacement_warmup_epochs": 12}
    whole, short = load_config(Method.RUBIZ, **late), load_config(Method.RUBIZ, epochs=3, **late)
    assert whole.cooldown_epochs > 3
    assert whole.displacement_start > 1
    assert (short.cooldown_epochs, short.displacement_start) == (3, 1)
    more = load_config(Method.RUBIZ, epochs=whole.epochs + 1, **late)
    assert more == whole.model_copy(update={"epochs": whole.epochs + 1})
    assert load_config(Method.RUBIZ, epochs=3, cooldown_epochs=1).cooldown_epochs == 1
    with pytest.raises(TrainingError, match="cooldown_epochs 4 is more than epochs 3"):
        load_config(Method.RUBIZ, epochs=3, cooldown_epochs=4)


def test_the_released_learning_rates() -> None:
    assert load_config(Method.CAB, published=True).learning_rate == 0.003
    assert load_config(Method.TRAJECTRON, published=True).learning_rate == 0.002


@pytest.mark.parametrize("method", list(Method))
def test_the_settings_on_a_card_are_a_settings_file(tmp_path: Path, method: Method) -> None:
    config = load_config(method, epochs=7, kl_weight=2.5)
    file = tmp_path / "settings.toml"
    file.write_text(config.toml())
    assert load_config(method, file) == config


def test_wrong_settings_are_named(tmp_path: Path) -> None:
    file = tmp_path / "x.toml"
    file.write_text("learning_rate = -1\nnot_there = 3\n")
    with pytest.raises(TrainingError, match="learning_rate"):
        load_config(Method.CAB, file)
    with pytest.raises(TrainingError, match="cannot be read"):
        load_config(Method.CAB, tmp_path / "nowhere.toml")
    file.write_text(load_config(Method.CAB).toml())
    with pytest.raises(TrainingError, match=r"has no table \[published\]"):
        load_config(Method.CAB, file, published=True)
    file.write_text("[published]\nstart = 'x'\n[published.network]\nmodes = 3\n")
    with pytest.raises(TrainingError, match="published: network, start cannot be there"):
        load_config(Method.CAB, file, published=True)
    file.write_text('description = ""\nlearning_rate = 1\n[network]\nkind = "covernet"\n')
    with pytest.raises(TrainingError, match="cab does not train a network of kind covernet"):
        load_config(Method.CAB, file)
    file.write_text('description = ""\nlearning_rate = 1\n[network]\nkind = "oracle"\n')
    with pytest.raises(TrainingError, match="network: kind must be cvae or covernet"):
        load_config(Method.CAB, file)
