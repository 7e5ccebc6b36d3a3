"""Comparison of two methods over seeds: means, intervals over trainings and scenes, and what is refused."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmark.bootstrap import Ratio
from benchmark.errors import BenchmarkError
from benchmark.results import BenchmarkResults, ContextRun, Instances
from benchmark.seeds import compare_seeds, table
from tests.benchmark.builders import made_metrics, made_model, made_results

PAIRS = 40
SCENES = np.repeat(np.arange(10), 4)
FDE = "fde_ml_6s_m"


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
    assert np.isnan(found["D, std"].interval).all()  # not held by scenes
    rows = {row[0]: row[1:] for row in table(list(found.values()), "trajectron", "cab").rows}
    assert rows["FDE-ML 6 s"][:3] == ("8.600 ± 0.141", "8.200 ± 0.200", "-0.400")
    assert rows["D, std"][3] == "-"


def test_figures_of_scenes_have_intervals(tmp_path: Path) -> None:
    """D by 2 instants a scene; the hardest 3 % are one pair, which tells no interval."""
    runs = []
    for seed, scale in enumerate((1.0, 3.0)):
        run = saved(tmp_path / str(seed), {"trajectron": 8.0, "cab": 8.0 - scale})
        held = Instances.read(run, PAIRS)
        mismatch_m = np.where(SCENES == 9, 60.0, 1.0) + np.arange(float(PAIRS))
        ratios = {
            f"{model.key}/dispersion_std_m": Ratio(np.full(10, 2 * size), np.full(10, 2.0))
            for model, size in zip(BenchmarkResults.read(run).models, (scale, 2 * scale), strict=True)
        }
        figures = {**held.figures, f"kalman@1.0.0/{FDE}": mismatch_m}
        replace(held, figures=figures, ratios=ratios).write(run)
        runs.append(run)
    found = {one.figure: one for one in compare_seeds(runs, "trajectron", "cab")}
    wider = math.sqrt(2)
    assert found["D, std"].interval == pytest.approx((2 - wider - 2 * wider, 2 + wider + 2 * wider), abs=0.1)
    assert np.isnan(found["FDE, hardest 3 %"].interval).all()


def test_trainings_that_lack_different_pairs_have_no_interval(tmp_path: Path) -> None:
    runs = [saved(tmp_path / str(seed), {"trajectron": 8.0, "cab": 7.0}) for seed in range(2)]
    held = Instances.read(runs[1], PAIRS)
    lacking = {name: np.where(np.arange(PAIRS) == 3, np.nan, values) for name, values in held.figures.items()}
    replace(held, figures=lacking).write(runs[1])
    (fde,) = (one for one in compare_seeds(runs, "trajectron", "cab") if one.figure == "FDE-ML 6 s")
    assert fde.difference == -1.0
    assert np.isnan(fde.interval).all()


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


def test_measures_of_the_context_by_other_models_are_refused(tmp_path: Path) -> None:
    runs = [saved(tmp_path / str(number), {"cab": 8.0}) for number in range(2)]
    for run, version in zip(runs, ("1.0.0", "2.0.0"), strict=True):
        context = ContextRun(f"trajectron-no-context@{version}", 2, 5, 5, 1.0)
        replace(BenchmarkResults.read(run), context=context).write(run)
    with pytest.raises(BenchmarkError, match="against another model"):
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
