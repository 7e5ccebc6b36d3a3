"""The figures of each pair and scene that a run holds, from which intervals are computed."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmark.bootstrap import Ratio
from benchmark.errors import BenchmarkError
from benchmark.results import ALL, INSTANCES_FILE, TURNS, Estimate, Instances, subset_figure
from tests.benchmark.builders import made_model

PAIRS = 100
SCENES = np.repeat(np.arange(10), 10)
FDE_M = np.arange(PAIRS, dtype=float)
MISMATCH_M = np.where(np.arange(PAIRS) < 90, 1.0, 50.0 + np.arange(PAIRS))
MISMATCH_M[99] = np.nan
INSTANCES = Instances(
    {
        "cab@1.0.0/fde_ml_6s_m": FDE_M,
        "kalman@1.9.0/fde_ml_6s_m": np.full(PAIRS, 1.0),
        "kalman@1.10.0/fde_ml_6s_m": MISMATCH_M,
    },
    SCENES,
    {"cab@1.0.0/dispersion_std_m": Ratio(np.arange(10.0), np.full(10, 2.0))},
)


def value(ratio: Ratio | None) -> float:
    assert ratio is not None
    return float(ratio.sums.sum() / ratio.divisors.sum())


def test_a_mean_over_pairs() -> None:
    ratio = INSTANCES.ratio("cab@1.0.0", "fde_ml_6s_m")
    assert value(ratio) == FDE_M.mean()
    assert ratio is not None
    np.testing.assert_array_equal(ratio.sums, FDE_M.reshape(10, 10).sum(axis=1))
    np.testing.assert_array_equal(ratio.divisors, np.full(10, 10))


def test_the_hardest_are_ranked_by_the_newest_kalman_filter() -> None:
    """3 of 99 pairs, as one has no mismatch: those with the largest."""
    assert value(INSTANCES.ratio("cab@1.0.0", "fde_hardest_3_m")) == np.mean([96.0, 97.0, 98.0])
    assert value(INSTANCES.ratio("cab@1.0.0", "fde_hardest_1_m")) == 98.0


def test_a_mean_over_instants() -> None:
    assert value(INSTANCES.ratio("cab@1.0.0", "dispersion_std_m")) == 45 / 20


@pytest.mark.parametrize(
    ("model", "figure"),
    [
        ("cab@1.0.0", "nll"),
        ("trajectron@1.0.0", "fde_ml_6s_m"),
        ("trajectron@1.0.0", "fde_hardest_3_m"),
        ("kalman@1.10.0", "compliance"),
    ],
)
def test_what_a_run_does_not_hold(model: str, figure: str) -> None:
    assert INSTANCES.ratio(model, figure) is None


def test_nothing_is_ranked_without_a_kalman_filter() -> None:
    figures = {"cab@1.0.0/fde_ml_6s_m": FDE_M}
    assert Instances(figures, SCENES).ratio("cab@1.0.0", "fde_hardest_3_m") is None
    figures["kalman@1.0.0/fde_ml_6s_m"] = np.full(PAIRS, np.nan)
    assert Instances(figures, SCENES).ratio("cab@1.0.0", "fde_hardest_3_m") is None


def test_without_scenes_there_are_no_ratios() -> None:
    assert Instances(INSTANCES.figures).ratio("cab@1.0.0", "fde_ml_6s_m") is None


def test_figures_are_written_and_read(tmp_path: Path) -> None:
    INSTANCES.write(tmp_path)
    found = Instances.read(tmp_path, PAIRS)
    assert found.scenes is not None
    np.testing.assert_array_equal(found.scenes, SCENES)
    assert found.figures.keys() == INSTANCES.figures.keys()
    for name, values in INSTANCES.figures.items():
        np.testing.assert_array_equal(found.figures[name], values)
    assert found.ratios.keys() == INSTANCES.ratios.keys()
    for name, ratio in INSTANCES.ratios.items():
        np.testing.assert_array_equal(found.ratios[name].sums, ratio.sums)
        np.testing.assert_array_equal(found.ratios[name].divisors, ratio.divisors)


def test_figures_over_scenes_alone_are_the_same(tmp_path: Path) -> None:
    names = ("fde_ml_6s_m", "fde_hardest_3_m", "dispersion_std_m", "nll")
    kept = INSTANCES.by_scenes(["cab@1.0.0", "kalman@1.10.0"], names)
    assert not kept.figures
    kept.write(tmp_path)
    found = Instances.read(tmp_path, PAIRS)
    for name in names[:-1]:
        assert value(found.ratio("cab@1.0.0", name)) == value(INSTANCES.ratio("cab@1.0.0", name))
    assert found.ratio("cab@1.0.0", "nll") is None


def test_a_figure_is_a_metric_or_a_measure_of_the_context() -> None:
    measures = {ALL: {"gain_m": Estimate(1.25, 0.5, 2.0, 10)}, TURNS: {"gain_m": Estimate(2.5, 1.0, 4.0, 3)}}
    model = replace(made_model("cab"), context=measures)
    assert (model.figure("gain_m"), model.figure(subset_figure("gain_m", TURNS))) == (1.25, 2.5)
    assert model.figure("nll") == model.metrics["nll"]
    assert np.isnan(model.figure("compliance"))


@pytest.mark.parametrize("shape", [(10,), (10, 3), (9, 2)])
def test_figures_by_scenes_of_another_form_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    INSTANCES.write(tmp_path)
    file = tmp_path / INSTANCES_FILE
    with np.load(file) as arrays:
        held: dict[str, Any] = dict(arrays)
    held["scene sums/cab@1.0.0/convergence_1m_s"] = np.ones(shape)
    np.savez(file, **held)
    with pytest.raises(BenchmarkError, match="figures by scenes are of"):
        Instances.read(tmp_path, PAIRS)


def test_a_model_with_a_slash_in_its_name_is_no_kalman_filter() -> None:
    assert Instances({"kalman/x@1.0.0/fde_ml_6s_m": FDE_M}, SCENES).mismatch_m() is None
