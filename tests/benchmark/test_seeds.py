"""Comparison of two methods over seeds: means, intervals over trainings and scenes, and what is refused."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmark.compare import bootstrap_interval
from benchmark.errors import BenchmarkError
from benchmark.results import BenchmarkResults, Instances
from benchmark.seeds import compare_seeds, seed_interval, table
from model.arrays import Floats, Ints
from tests.benchmark.builders import made_metrics, made_model, made_results

PAIRS = 40
SCENES = np.repeat(np.arange(10), 4)
FDE = "fde_ml_6s_m"


def figures(seed: int, mean: float) -> Floats:
    return np.random.default_rng(seed).normal(mean, 1.0, PAIRS)


def saved(folder: Path, fde: dict[str, float], plan: str = "0123") -> Path:
    """A run whose models have that FDE at every pair."""
    folder.mkdir()
    models = [
        made_model(name, metrics=made_metrics() | {FDE: value, "nll": math.nan})
        for name, value in fde.items()
    ]
    replace(made_results(*models), pairs=PAIRS, plan=plan).write(folder)
    each = {f"{model.key}/{FDE}": np.full(PAIRS, fde[model.name]) for model in models}
    Instances(each, SCENES).write(folder)
    return folder


def test_a_single_training_has_the_interval_over_scenes() -> None:
    a, b = figures(0, 8.0), figures(1, 7.0)
    low, high = seed_interval(a[None], b[None], SCENES)
    assert (low, high) == pytest.approx(bootstrap_interval(b - a, SCENES), abs=0.1)


def test_trainings_that_differ_widen_the_interval() -> None:
    a, b = np.stack([figures(0, 8.0)] * 3), np.stack([figures(1, 7.0)] * 3)
    alike = seed_interval(a, b, SCENES)
    apart = seed_interval(a, b + np.array([[-1.0], [0.0], [1.0]]), SCENES)
    assert apart[0] < alike[0] - 0.3
    assert apart[1] > alike[1] + 0.3


def test_constants_by_hand() -> None:
    a, b = np.full((2, PAIRS), 8.0), np.full((3, PAIRS), 7.0)
    assert seed_interval(a, b, SCENES) == pytest.approx((-1.0, -1.0))
    b[1] = 10.0
    low, high = seed_interval(a, b, SCENES)
    wider = math.sqrt(3 / 2)  # of the three drawn trainings, none or all are the second one
    assert low == pytest.approx(0.0 - wider)
    assert high == pytest.approx(0.0 + 2 * wider)


def test_pairs_that_a_training_lacks_do_not_count() -> None:
    a, b = np.full((1, PAIRS), 8.0), np.full((2, PAIRS), 7.0)
    a[0, :4], b[1, 8:12] = np.nan, np.nan
    b[0, :12] = 100.0
    b[0, 4:8] = 7.0
    assert seed_interval(a, b, SCENES) == pytest.approx((-1.0, -1.0))


@pytest.mark.parametrize("scenes", [np.zeros(PAIRS, dtype=np.int64), np.arange(PAIRS)])
def test_one_scene_tells_no_interval(scenes: Ints) -> None:
    a, b = figures(0, 8.0)[None], figures(1, 7.0)[None]
    if len(set(scenes.tolist())) > 1:
        b[:, 1:] = np.nan
    assert np.isnan(seed_interval(a, b, scenes)).all()


def test_runs_of_trainings_are_compared(tmp_path: Path) -> None:
    runs = [
        saved(tmp_path / "0", {"trajectron": 8.5, "cab": 8.0}),
        saved(tmp_path / "1", {"trajectron": 8.7, "cab": 8.4}),
        saved(tmp_path / "2", {"cab": 8.2}),
    ]
    found = {one.figure: one for one in compare_seeds(runs, "trajectron", "cab")}
    fde = found["FDE-ML 6 s"]
    assert (fde.a, fde.b) == ((8.5, 8.7), (8.0, 8.4, 8.2))
    assert fde.difference == pytest.approx(-0.4)
    low, high = fde.interval
    assert low < -0.4 < high < 0
    assert "NLL" not in found  # no training has it
    assert np.isnan(found["D, std"].interval).all()
    rows = {row[0]: row[1:] for row in table(list(found.values()), "trajectron", "cab").rows}
    assert rows["FDE-ML 6 s"][:3] == ("8.600 ± 0.141", "8.200 ± 0.200", "-0.400")
    assert rows["D, std"][3] == "-"


def test_a_run_of_other_pairs_is_refused(tmp_path: Path) -> None:
    runs = [saved(tmp_path / "0", {"cab": 8.0}), saved(tmp_path / "1", {"cab": 8.0}, plan="4567")]
    with pytest.raises(BenchmarkError, match="other plan"):
        compare_seeds(runs, "cab", "cab")


def test_a_run_that_is_given_twice_is_refused(tmp_path: Path) -> None:
    run = saved(tmp_path / "0", {"cab": 8.0})
    with pytest.raises(BenchmarkError, match="twice"):
        compare_seeds([run, run], "cab", "cab")


def test_runs_of_other_settings_are_refused(tmp_path: Path) -> None:
    runs = [saved(tmp_path / str(number), {"cab": 8.0}) for number in range(2)]
    replace(BenchmarkResults.read(runs[1]), samples=7).write(runs[1])
    with pytest.raises(BenchmarkError, match="other samples"):
        compare_seeds(runs, "cab", "cab")


def test_a_method_that_no_run_has_is_named(tmp_path: Path) -> None:
    runs = [saved(tmp_path / "0", {"cab": 8.0})]
    with pytest.raises(BenchmarkError, match="no run has trajectron"):
        compare_seeds(runs, "trajectron", "cab")


def test_two_versions_in_a_run_are_refused(tmp_path: Path) -> None:
    (tmp_path / "0").mkdir()
    made_results(made_model("cab"), made_model("cab", "1.1.0")).write(tmp_path / "0")
    with pytest.raises(BenchmarkError, match="one a run"):
        compare_seeds([tmp_path / "0"], "cab", "cab")
