from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.data.protocols import frame_scene
from model.evaluation.ablation import Without
from model.evaluation.in_process import ModelMeans, evaluate_checkpoints, open_validations
from model.evaluation.selection import Learned, select
from model.forecaster import Protocol
from model.metrics.evaluate import instance_metrics
from model.metrics.pairs import Sampling
from model.training import validation
from tests.model.data.records import FixedReader, record
from tests.model.evaluation.builders import checkpoints, save_covernet

READER = FixedReader(record(), record("scene-2", seed=1))
NO_DRAWS = Sampling(0, 0)


def evaluate(
    folder: Path,
    models: tuple[Learned, ...],
    sampling: Sampling = NO_DRAWS,
    ablate: bool = False,
    limit: int | None = None,
) -> dict[str, ModelMeans]:
    """On one cache for all of them."""
    said: list[str] = []
    ((found, group),) = open_validations(models, folder, READER, "made", "some", Protocol.CAUSAL, said.append)
    assert group == list(models)
    return evaluate_checkpoints(found, models, ablate, sampling, limit)


@pytest.fixture
def models(tmp_path: Path) -> tuple[Learned, ...]:
    """cab and trajectron-no-context of random weights."""
    return select(checkpoints(tmp_path / "models"), Protocol.CAUSAL).learned


def test_figures_are_those_of_forecasts_from_the_scene(tmp_path: Path, models: tuple[Learned, ...]) -> None:
    """A cache's features and patches are those that a server makes of the scene."""
    means = evaluate(tmp_path, models, Sampling(8, 9))
    for model in models:
        fde: list[float] = []
        off_road: list[float] = []
        for one in READER.scenes("some"):
            for pair in one.pairs:
                scene, tracks = frame_scene(one, pair.frame, Protocol.CAUSAL, 5)
                now = int(np.searchsorted(one.tracks[pair.track].frames, pair.frame))
                truth = one.tracks[pair.track].position[None, now + 1 : now + 13]
                forecast = model.forecaster(scene, np.flatnonzero(tracks == pair.track))
                seeds = [len(fde)]
                metrics = instance_metrics(forecast, truth, [one.raster], seeds, samples=8, draws=0)
                fde += metrics["fde_f_6s_m"].tolist()
                off_road += metrics["off_road_ml"].tolist()
        found = means[f"{model.info.name}@1.0.0"].metrics
        assert found.mean("fde_f_6s_m") == pytest.approx(np.mean(fde), rel=1e-3)
        assert found.mean("off_road_ml") == pytest.approx(np.mean(off_road), abs=0.02)
        assert found.count("inside_90") == len(fde)


def test_batches_make_no_difference(
    tmp_path: Path, models: tuple[Learned, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = evaluate(tmp_path, models, Sampling(8, 9))
    monkeypatch.setattr(validation, "BATCH", 7)
    cut = evaluate(tmp_path, models, Sampling(8, 9))
    for name, one in whole.items():
        for metric, value in one.metrics.means().items():
            assert cut[name].metrics.mean(metric) == pytest.approx(value, rel=1e-4, abs=1e-4), metric


def test_a_cache_tells_who_stood_as_the_scene_does(tmp_path: Path, models: tuple[Learned, ...]) -> None:
    scene = record()
    first = scene.tracks[0]
    still = first.position.copy()
    still[:8] = still[7]
    scene = replace(scene, tracks=[replace(first, position=still), *scene.tracks[1:]])
    expected = scene.stood(scene.pairs)
    assert [pair.frame for pair, stood in zip(scene.pairs, expected, strict=True) if stood] == [4, 5, 6, 7]
    ((found, _),) = open_validations(
        models, tmp_path, FixedReader(scene), "made", "some", Protocol.CAUSAL, lambda said: None
    )
    np.testing.assert_array_equal(np.concatenate([batch.pairs.stood for batch in found.batches()]), expected)
    means = evaluate_checkpoints(found, models, False, NO_DRAWS)["cab@1.0.0"].metrics
    assert means.count("moving_fde_ml_6s_m") == means.count("fde_ml_6s_m") - 4
    assert means.figures()["merged_modes_90_median"] in (1, 1.5, 2, 2.5, 3)


def test_ablation_removes_only_what_a_model_uses(tmp_path: Path, models: tuple[Learned, ...]) -> None:
    means = evaluate(tmp_path, models, ablate=True, limit=20)
    cab, alone = means["cab@1.0.0"], means["trajectron-no-context@1.0.0"]
    assert set(cab.ablated) == set(Without)
    assert not alone.ablated
    errors = {one.mean("ade_ml_6s_m") for one in (cab.metrics, *cab.ablated.values())}
    assert len(errors) == 4  # each of them matters to random weights
    assert all(one.count("ade_ml_6s_m") == 20 for one in (cab.metrics, alone.metrics, *cab.ablated.values()))


def test_covernet_has_a_cache_of_its_own(tmp_path: Path) -> None:
    save_covernet(checkpoints(tmp_path / "models") / "covernet")
    models = select(tmp_path / "models", Protocol.CAUSAL).learned
    said: list[str] = []
    opened = list(open_validations(models, tmp_path, READER, "made", "some", Protocol.CAUSAL, said.append))
    assert [[one.info.name for one in group] for _, group in opened] == [
        ["cab", "trajectron-no-context"],
        ["covernet"],
    ]
    (found, group) = opened[1]
    means = evaluate_checkpoints(found, group, True, NO_DRAWS)["covernet@1.0.0"]
    assert set(means.ablated) == set(Without)
    nll = {one.mean("nll") for one in (means.metrics, *means.ablated.values())}
    assert len(nll) == 4  # the boxes, too, are taken away


def test_caches_are_made_once(tmp_path: Path, models: tuple[Learned, ...]) -> None:
    said: list[str] = []
    for _ in range(2):
        list(open_validations(models, tmp_path, READER, "made", "some", Protocol.CAUSAL, said.append))
    assert len(said) == 2
    assert said[0].startswith("The cache of some does not exist yet")
    assert "from 2 scenes built" in said[1]
