"""Submissions: their form, and that what they say is what was answered."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmark.answers import CallTimes, SceneAnswers
from benchmark.errors import BenchmarkError
from benchmark.plan import PlannedScene
from benchmark.submission import MAX_MODES, Entry, submission_entries, write_submission
from model.arrays import Floats
from model.metrics.evaluate import instance_metrics
from model.metrics.multimodal import TOP_K, min_ade_m, min_fde_m, missed
from model.mixture import TrajectoryMixture
from tests.model.data.records import record
from tests.model.metrics.builders import random_mixture


def planned(token: bool = True) -> PlannedScene:
    """A scene without calls."""
    made = record(token=token)
    return PlannedScene(made, made.pairs, 0, ())


SCENE = planned()
PAIRS = len(SCENE.pairs)


def answered(mixture: TrajectoryMixture) -> SceneAnswers:
    """Answers to the first pairs, as many as the mixture has."""
    return SceneAnswers(np.arange(len(mixture)), mixture, {}, 0, {}, CallTimes(*[np.zeros(0)] * 4))


def wandering(modes: int, seed: int = 0) -> TrajectoryMixture:
    """Forecasts that are some metres off the truth."""
    mixture = random_mixture(seed, PAIRS, modes)
    origin = torch.from_numpy(SCENE.origin())
    off = mixture.means.cumsum(dim=2) / 10
    means = torch.from_numpy(SCENE.truth())[:, None] - origin[:, None, None] + off
    return TrajectoryMixture(mixture.log_weights, means, mixture.covariances, origin)


def weighted(mixture: TrajectoryMixture, weights: Floats) -> TrajectoryMixture:
    """Mixture with the weights [K] in all rows."""
    with np.errstate(divide="ignore"):
        logs = torch.from_numpy(np.log(weights)).expand(len(mixture), -1)
    return replace(mixture, log_weights=logs)


def figures(entries: list[Entry]) -> dict[str, Floats]:
    """Figures of the entries, one after the other, as a reader computes them."""
    found: dict[str, list[float]] = {}
    for entry, truth in zip(entries, SCENE.truth()[:, None], strict=True):
        modes = np.array(entry["prediction"])[None]
        probabilities = np.array(entry["probabilities"])[None]
        for k in TOP_K:
            for name, metric in (("min_ade_{}_m", min_ade_m), ("min_fde_{}_m", min_fde_m)):
                found.setdefault(name.format(k), []).append(metric(modes, probabilities, truth, k).item())
            found.setdefault(f"miss_rate_{k}", []).append(missed(modes, probabilities, truth, k).item())
    return {name: np.array(values) for name, values in found.items()}


def assert_same_figures(entries: list[Entry], mixture: TrajectoryMixture) -> None:
    expected = instance_metrics(mixture, SCENE.truth())
    for name, values in figures(entries).items():
        np.testing.assert_array_equal(values, expected[name], name)


def test_what_was_answered_comes_back_out_of_the_file(tmp_path: Path) -> None:
    mixture = wandering(7)
    write_submission(submission_entries(SCENE, answered(mixture)), tmp_path / "submission.json")
    entries = json.loads((tmp_path / "submission.json").read_text())
    assert [path.name for path in tmp_path.iterdir()] == ["submission.json"]
    assert [f"{entry['instance']}_{entry['sample']}" for entry in entries] == [
        pair.token for pair in SCENE.pairs
    ]
    order = mixture.log_weights.argsort(dim=1, descending=True)
    for row, entry in enumerate(entries):
        assert list(entry) == ["instance", "sample", "prediction", "probabilities"]
        np.testing.assert_array_equal(entry["prediction"], mixture.world_means[row, order[row]])
        np.testing.assert_allclose(entry["probabilities"], mixture.weights[row, order[row]], rtol=1e-12)
    assert_same_figures(entries, mixture)


@pytest.mark.parametrize("modes", [1, 3, MAX_MODES, MAX_MODES + 1, 3 * MAX_MODES])
def test_the_most_likely_modes_are_kept(modes: int) -> None:
    mixture = wandering(modes, seed=modes)
    entries = submission_entries(SCENE, answered(mixture))
    kept = min(modes, MAX_MODES)
    for row, entry in enumerate(entries):
        assert np.shape(entry["prediction"]) == (kept, 12, 2)
        assert math.fsum(entry["probabilities"]) == pytest.approx(1, abs=1e-12)
        best = mixture.weights[row].sort(descending=True).values[:kept]
        np.testing.assert_allclose(entry["probabilities"], best / best.sum(), rtol=1e-9)
    assert_same_figures(entries, mixture)


def test_no_two_modes_are_equally_likely() -> None:
    """So that no sort, stable or not, ranks them otherwise than ours."""
    weights = np.repeat([0.0, 0.02, 0.06], [4, 15, 10])
    mixture = weighted(wandering(len(weights)), weights / weights.sum())
    entries = submission_entries(SCENE, answered(mixture))
    for entry in entries:
        assert (np.diff(entry["probabilities"]) < 0).all()
    assert_same_figures(entries, mixture)


def test_modes_without_weight_stay_but_padding_does_not() -> None:
    mixture = weighted(wandering(5), np.array([0.7, 0.3, 0.0, 0.0, 0.0]))
    mixture.means[:, 3:] = mixture.means[:, :1]  # as of a fallback among others
    entries = submission_entries(SCENE, answered(mixture))
    for row, entry in enumerate(entries):
        np.testing.assert_array_equal(entry["prediction"], mixture.world_means[row, :3])
        assert entry["probabilities"][:2] == pytest.approx([0.7, 0.3])
    assert_same_figures(entries, mixture)


@pytest.mark.parametrize("weights", [[0.5, 0.3, 0.2], [0.0, 0.6, 0.4]])
def test_modes_that_were_said_stay(weights: list[float]) -> None:
    """Alike, but with weight; or the first one, though it has none."""
    mixture = weighted(wandering(3), np.array(weights))
    mixture.means[:, 1] = mixture.means[:, 0]
    entries = submission_entries(SCENE, answered(mixture))
    assert {len(entry["prediction"]) for entry in entries} == {3}
    assert_same_figures(entries, mixture)


def test_data_without_tokens() -> None:
    with pytest.raises(BenchmarkError, match="scene-1: a submission needs data with tokens"):
        submission_entries(planned(token=False), answered(wandering(3)))


@pytest.mark.parametrize("missing", [[0], [3, 5], range(PAIRS)])
def test_every_pair_needs_a_forecast(missing: list[int]) -> None:
    known = np.setdiff1d(np.arange(PAIRS), missing)
    mixture = wandering(3)[torch.from_numpy(known)] if known.size else None
    partly = replace(answered(wandering(3)), instances=known, mixture=mixture)
    with pytest.raises(BenchmarkError) as caught:
        submission_entries(SCENE, partly)
    assert f"{len(missing)} of {PAIRS} have none" in str(caught.value)
    assert str(caught.value).endswith(f"the first {SCENE.pairs[missing[0]].token}")


def test_what_cannot_be_submitted() -> None:
    short = wandering(3)
    short = replace(short, means=short.means[:, :, :8], covariances=short.covariances[:, :, :8])
    with pytest.raises(BenchmarkError, match="12 steps, not 8"):
        submission_entries(SCENE, answered(short))
    broken = wandering(3)
    broken.means[2, 1, 4] = torch.inf
    with pytest.raises(BenchmarkError, match="scene-1: there are forecasts that are not finite"):
        submission_entries(SCENE, answered(broken))


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    file = tmp_path / "submission.json"
    entries = submission_entries(SCENE, answered(wandering(2)))

    def breaking() -> Iterator[Entry]:
        yield from entries
        raise BenchmarkError("scene-2: a submission needs a forecast of every pair")

    write_submission(entries[:1], file)
    with pytest.raises(BenchmarkError):
        write_submission(breaking(), file)
    assert json.loads(file.read_text()) == entries[:1]
    assert list(tmp_path.iterdir()) == [file]
    write_submission([], file)
    assert json.loads(file.read_text()) == []
    with pytest.raises(FileNotFoundError):
        write_submission(entries, tmp_path / "nowhere" / "submission.json")
