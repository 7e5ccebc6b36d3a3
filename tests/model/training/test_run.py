"""From data to a checkpoint that serves."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from model.checkpoint import load_checkpoint
from model.data.scenes import DataError
from model.data.sources import READERS, parse_data
from model.features.spec import Frame
from model.forecaster import Protocol
from model.networks.config import BlindContext, CoverNetConfig, NetworkConfig
from model.registry import Registry
from model.scenes.scene import AgentType
from model.training.calibration import MAX_FACTOR, Calibration
from model.training.card import RAN_AWAY
from model.training.config import Method
from model.training.run import Run, Source
from model.training.state import Progress, RunLog
from tests.model.data.records import FixedReader, record
from tests.model.training.fakes import small_config


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Return a run over two made-up scenes."""
    reader = FixedReader(record(), record("scene-2", seed=1))
    monkeypatch.setitem(READERS, "made", lambda path: reader)
    source = Source("made", tmp_path, "some", "some", Protocol.CAUSAL)
    return Run(small_config(Method.CAB, epochs=2), source, tmp_path / "run", tmp_path / "cache", "1.2.3")


def go(run: Run) -> tuple[Path, list[Progress]]:
    """Run it; return the checkpoint's folder and each epoch's progress."""
    reports: list[Progress] = []
    folder = run.train(
        lambda progress, figures: reports.append(progress),
        lambda *_: None,
        lambda _: None,
    )
    return folder, reports


def test_a_run_ends_in_a_checkpoint_that_the_registry_loads(run: Run) -> None:
    folder, reports = go(run)
    assert [progress.epoch for progress in reports] == [1, 2]
    models = folder.parent.parent / "models"
    models.mkdir()
    folder.rename(models / "cab")
    info = Registry.load(models).get("cab").info
    assert info.version == "1.2.3"
    assert info.protocol is Protocol.CAUSAL
    assert np.isfinite(info.benchmark["fde_ml_6s_m"])
    assert {"ade_f_6s_m", "off_road_ml", "inside_90", "nll"} <= info.benchmark.keys()
    card = (models / "cab/README.md").read_text()
    command = "cab-forecast train cab --data made:DATA"
    for said in ("causal", "seed 0", command, "standard deviations times", "non-commercial", "fde_ml_6s_m"):
        assert said in card
    assert str(run.out) not in card


@pytest.mark.parametrize("method", [Method.CAB, Method.RUBIZ])
def test_what_was_calibrated_is_in_the_checkpoint_and_on_its_card(run: Run, method: Method) -> None:
    folder, _ = go(replace(run, config=small_config(method, epochs=1)))
    trained, shipped = load_file(run.out / "best.safetensors"), load_checkpoint(folder).tensors
    changed = {name for name, tensor in trained.items() if not torch.equal(tensor, shipped[name])}
    width, bias = "vehicle.full.decoder.log_sigma.bias", "vehicle.prior_logits.bias"
    blind = {"vehicle.blind.decoder.log_sigma.bias"} if method is Method.RUBIZ else set()
    assert changed == {width, bias, "vehicle.prior_logits.weight"} | blind
    factor = (shipped[width] - trained[width]).exp()[0].item()
    divisor = (trained[bias] / shipped[bias])[0].item()
    card = (folder / "README.md").read_text()
    assert f"standard deviations times {factor:.3f}" in card
    assert f"divided by {divisor:.3f}" in card
    of_blind = [(shipped[name] - trained[name]).exp()[0].item() for name in blind]
    assert (RAN_AWAY in card) is Calibration(factor, divisor, *of_blind).ran_away
    assert ("of blind forecasts" in card) is bool(blind)


def test_a_calibration_that_ran_away_is_said(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    once = replace(run, config=small_config(Method.CAB, epochs=1))
    monkeypatch.setattr("model.training.run.fit_calibration", lambda *_: Calibration(1.0, MAX_FACTOR))
    folder = once.train(lambda *_: None, lambda *_: None, said.append)
    assert any(RAN_AWAY in line for line in said)
    assert RAN_AWAY in (folder / "README.md").read_text()


def test_without_calibration_the_checkpoint_is_what_was_trained(run: Run) -> None:
    folder, _ = go(replace(run, config=small_config(Method.CAB, epochs=1, calibrate=False)))
    trained, shipped = load_file(run.out / "best.safetensors"), load_checkpoint(folder).tensors
    assert all(torch.equal(tensor, shipped[name]) for name, tensor in trained.items())
    assert "**Calibration**: none" in (folder / "README.md").read_text()


def test_a_run_of_covernet_ends_in_a_checkpoint_with_its_cover(run: Run) -> None:
    folder, _ = go(replace(run, config=small_config(Method.COVERNET, epochs=1)))
    checkpoint = load_checkpoint(folder)
    assert isinstance(checkpoint.network, CoverNetConfig)
    assert checkpoint.network.members == len(checkpoint.tensors["vehicle.cover"]) > 5
    assert checkpoint.info.modes == checkpoint.network.modes == 5
    assert checkpoint.info.context_types == (AgentType.VEHICLE, AgentType.PEDESTRIAN)
    assert np.isfinite(checkpoint.info.benchmark["nll"])
    # A cache of its own, beside those of the other methods
    assert [file.name for file in run.cache.iterdir()] == ["made-48168fa9-some-causal-5-vp-drawn"]


def test_an_interrupted_run_goes_on(run: Run) -> None:
    go(replace(run, config=run.config.model_copy(update={"epochs": 1})))
    _, reports = go(run)
    assert [progress.epoch for progress in reports] == [2]
    rows = RunLog(run.out).rows()
    assert [row["epoch"] for row in rows] == ["1", "2"]
    assert all(float(row["loss"]) == float(row["loss"]) for row in rows)


def test_a_paper_checkpoint_is_served_on_an_explicit_opt_in_only(run: Run) -> None:
    folder, _ = go(replace(run, source=replace(run.source, protocol=Protocol.PAPER)))
    models = folder.parent.parent / "models"
    models.mkdir()
    folder.rename(models / "cab")
    with pytest.raises(Exception, match="paper protocol"):
        Registry.load(models)
    assert Registry.load(models, allow_paper=True).get("cab").info.protocol is Protocol.PAPER


def test_what_cannot_be_trained_on_is_said(run: Run, tmp_path: Path) -> None:
    with pytest.raises(DataError):
        go(replace(run, source=replace(run.source, train_split="none")))
    kind, path = parse_data(f"nuscenes_pred:{tmp_path / 'nothing'}")
    with pytest.raises(DataError, match="nothing"):
        go(replace(run, source=replace(run.source, kind=kind, path=path, train_split="train")))


def test_a_log_replaces_the_rows_of_epochs_done_again(tmp_path: Path) -> None:
    log = RunLog(tmp_path)
    for epoch, loss in ((1, 3.0), (2, 2.0), (2, 1.0)):
        log.add(Progress(epoch, epoch * 10, epoch, loss, 1.0), {"loss": loss})
    assert [(row["epoch"], row["loss"]) for row in log.rows()] == [("1", "3.0"), ("2", "1.0")]


@pytest.mark.parametrize(
    ("method", "blind"),
    [
        (Method.CAB, BlindContext.NULL),
        (Method.TRAJECTRON, BlindContext.NONE),
        (Method.RUBIZ, BlindContext.OWN),
        (Method.HALENTNET, BlindContext.NONE),
    ],
)
def test_a_run_in_the_agents_frame_on_several_sources(run: Run, method: Method, blind: BlindContext) -> None:
    network = NetworkConfig(frame=Frame.AGENT, far_map=True, blind=blind, modes=6)
    config = small_config(
        method,
        epochs=2,
        network=network,
        rotate=False,
        mirror=True,
        variants=1,
        context_dropout=True,
        stopped_vehicles=True,
        jitter=True,
        keep="last",
        weight_decay=0.01,
        leaving_keep_probability=0.5,
    )
    source = replace(run.source, also=(("made", run.source.path, "some"),), report_split="some")
    own = replace(run, config=config, source=source)
    folder, reports = go(own)
    assert [progress.best_epoch for progress in reports] == [1, 2]
    checkpoint = load_checkpoint(folder)
    assert checkpoint.network.model_dump() == network.model_dump()
    vehicles = checkpoint.tensors
    assert vehicles["vehicle.width"].shape == (12,)
    assert not torch.equal(vehicles["vehicle.width"], torch.ones(12))
    card = (folder / "README.md").read_text()
    for told in (
        "Differs from the published network",
        "merged forecasts",
        "--also made:DATA@some",
        "context_dropout = true",
    ):
        assert told in card, told
    # What the card holds trains again
    settings = tomllib.loads(card.split("```toml\n")[1].split("```")[0])
    assert settings["mixture"]["min_ade"] == config.mixture.min_ade
    assert checkpoint.info.trained_on.count("split some") == 2
    # An interrupted run comes to the same, whatever was drawn
    first = replace(own, out=run.out.parent / "parts", config=config.model_copy(update={"epochs": 1}))
    go(first)
    second, _ = go(replace(first, config=config))
    for name, tensor in load_checkpoint(second).tensors.items():
        torch.testing.assert_close(tensor, vehicles[name], atol=1e-6, rtol=1e-5, msg=name)


def test_covernet_is_trained_in_the_agents_frame(run: Run) -> None:
    network = CoverNetConfig(frame=Frame.AGENT, far_map=True, modes=6)
    config = small_config(
        Method.COVERNET,
        network=network,
        rotate=False,
        variants=1,
        context_dropout=True,
        stopped_vehicles=True,
        jitter=True,
    )
    folder, _ = go(replace(run, config=config))
    checkpoint = load_checkpoint(folder)
    assert isinstance(checkpoint.network, CoverNetConfig)
    assert checkpoint.network.model_copy(update={"members": 0}) == network
    assert {"vehicle.far_picture.convs.0.weight", "vehicle.cover"} <= checkpoint.tensors.keys()
    card = (folder / "README.md").read_text()
    settings = tomllib.loads(card.split("```toml\n")[1].split("```")[0])
    assert "mixture" not in settings
    assert settings["network"]["far_map"] is True
