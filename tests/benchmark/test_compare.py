import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from benchmark.bootstrap import Ratio
from benchmark.compare import Comparison, Difference, compare, markdown, table
from benchmark.errors import BenchmarkError
from benchmark.results import INSTANCES_FILE, BenchmarkResults, Instances
from model.arrays import Floats, Ints
from model.evaluation.results import RESULTS_FILE
from model.forecaster import Protocol
from tests.benchmark.builders import made_metrics, made_model, made_oracle, made_results

PAIRS = 10
FDE = "cab@1.0.0/fde_ml_6s_m"
NONE: Mapping[str, Floats] = MappingProxyType({})


def saved(
    folder: Path,
    results: BenchmarkResults,
    figures: Mapping[str, Floats] = NONE,
    scenes: Ints | None = None,
) -> Path:
    """A run's folder; figures of each pair where there are any."""
    folder.mkdir()
    results.write(folder)
    if figures:
        Instances(figures, scenes).write(folder)
    return folder


def difference(comparison: Comparison, figure: str, model: int = 0) -> Difference:
    (found,) = (one for one in comparison.models[model].differences if one.figure == figure)
    return found


def two(tmp_path: Path, a: BenchmarkResults, b: BenchmarkResults) -> Comparison:
    return compare(saved(tmp_path / "a", a), saved(tmp_path / "b", b))


def test_the_standard_error_by_hand(tmp_path: Path) -> None:
    apart = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, np.nan, 1.0])
    a = np.full(PAIRS, 5.0)
    a[9] = np.nan  # so that eight pairs are in both
    comparison = compare(
        saved(tmp_path / "a", made_results(), {FDE: a}),
        saved(tmp_path / "b", made_results(), {FDE: 5.0 + apart}),
    )
    found = difference(comparison, "FDE-ML 6 s")
    assert found.pairs == 8
    assert found.difference == pytest.approx(4.5)
    assert found.standard_error == pytest.approx(math.sqrt(6.0 / 8))
    assert found.clear
    assert difference(comparison, "ADE-ML 6 s").pairs == 0
    row = next(line for line in table(comparison).rows if line[1] == "FDE-ML 6 s")
    assert row == ("cab@1.0.0", "FDE-ML 6 s", "7.200", "7.200", "+4.500", "0.866", "-", "8", "yes")


def test_a_difference_within_noise_is_not_clear(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    a = generator.normal(8.0, 3.0, PAIRS)
    comparison = compare(
        saved(tmp_path / "a", made_results(), {FDE: a}),
        saved(tmp_path / "b", made_results(), {FDE: a + np.tile([1.0, -0.9], PAIRS // 2)}),
    )
    assert difference(comparison, "FDE-ML 6 s").clear is False
    assert comparison.remarks == ()


def test_the_same_run_differs_in_nothing(tmp_path: Path) -> None:
    figures = {FDE: np.arange(PAIRS, dtype=np.float64)}
    comparison = compare(
        saved(tmp_path / "a", made_results(), figures), saved(tmp_path / "b", made_results(), figures)
    )
    found = difference(comparison, "FDE-ML 6 s")
    assert (found.difference, found.standard_error, found.clear) == (0.0, 0.0, False)
    assert {one.difference for one in comparison.models[0].differences} == {0.0}


def test_one_pair_has_no_standard_error(tmp_path: Path) -> None:
    lone = np.full(PAIRS, np.nan)
    lone[0] = 1.0
    comparison = compare(
        saved(tmp_path / "a", made_results(), {FDE: lone}),
        saved(tmp_path / "b", made_results(), {FDE: 2 * lone}),
    )
    found = difference(comparison, "FDE-ML 6 s")
    assert (found.difference, found.pairs, found.clear) == (1.0, 1, None)
    assert math.isnan(found.standard_error)


def test_what_differs_is_said_in_words(tmp_path: Path) -> None:
    a = made_results()
    b = replace(made_results(protocol=Protocol.PAPER), split="other", seed=4, limit=10, consistency=False)
    remarks = two(tmp_path, a, replace(b, plan="fedcba9876543210")).remarks
    assert remarks == (
        "protocol: causal in A, paper in B",
        "split: some in A, other in B",
        "limit: none in A, 10 in B",
        "consistency: yes in A, no in B",
        "seed: 3 in A, 4 in B",
        "the plans differ (other pairs, calls or data): 0123456789ab in A, fedcba987654 in B",
        "the runs are of other pairs or plans: no paired comparison",
        "measures of the context are not compared: by trajectron-no-context@1.0.0, 2 donors and seed 3 in A "
        "and trajectron-no-context@1.0.0, 2 donors and seed 4 in B",
    )


def test_measures_of_the_context_by_other_donors_are_not_compared(tmp_path: Path) -> None:
    a = made_results()
    assert a.context is not None
    alike = two(tmp_path, a, a)
    assert difference(alike, "Gain, turns after now").difference == 0.0
    (tmp_path / "more").mkdir()
    other = two(tmp_path / "more", a, replace(a, context=replace(a.context, donors=5)))
    assert "Gain" not in {one.figure for one in other.models[0].differences}
    assert other.remarks == (
        "no figures of each pair in A and B: no paired comparison",
        "measures of the context are not compared: by trajectron-no-context@1.0.0, 2 donors and seed 3 in A "
        "and trajectron-no-context@1.0.0, 5 donors and seed 3 in B",
    )


def test_figures_by_scenes_have_an_interval_and_no_standard_error(tmp_path: Path) -> None:
    """D of 2 m in both of two scenes in A, of 2 and 4 m in B, as a run holds it that is kept by scenes."""
    key = "cab@1.0.0/dispersion_std_m"
    runs = []
    for name, second in (("a", 2.0), ("b", 4.0)):
        run = saved(tmp_path / name, made_results())
        Instances({}, None, {key: Ratio(np.array([2.0, second]), np.ones(2))}).write(run)
        runs.append(run)
    comparison = compare(*runs)
    found = difference(comparison, "D, std")
    assert (found.interval, found.pairs, found.clear) == ((0.0, 2.0), 0, None)
    assert math.isnan(found.standard_error)
    assert comparison.remarks == ()


def test_pairs_of_another_plan_are_not_compared_one_by_one(tmp_path: Path) -> None:
    figures = {FDE: np.arange(PAIRS, dtype=np.float64)}
    comparison = compare(
        saved(tmp_path / "a", made_results(), figures),
        saved(tmp_path / "b", replace(made_results(), plan="other"), figures),
    )
    assert difference(comparison, "FDE-ML 6 s").pairs == 0


def test_without_figures_of_each_pair_the_means_are_compared(tmp_path: Path) -> None:
    better = made_results(made_model(metrics=made_metrics(0.5)))
    comparison = two(tmp_path, made_results(), better)
    found = difference(comparison, "FDE-ML 6 s")
    assert (found.a, found.b, found.difference) == (7.2, 3.6, -3.6)
    assert found.clear is None
    assert comparison.remarks == ("no figures of each pair in A and B: no paired comparison",)


def test_models_are_matched_by_key_then_by_name(tmp_path: Path) -> None:
    a = made_results(
        made_model("cab"),
        made_model("cab", "1.1.0"),
        made_model("rubiz"),
        made_model("gone"),
        made_model("covernet", "1.0.0"),
        made_model("covernet", "1.1.0"),
        made_oracle(),
    )
    b = made_results(
        made_model("rubiz", "2.0.0", "paper"),
        made_model("cab"),
        made_model("cab", "1.2.0"),
        made_model("cab", "1.3.0"),
        made_model("new"),
        made_model("covernet", "1.2.0"),
        made_oracle(),
    )
    comparison = two(tmp_path, a, b)
    assert [(model.a, model.b) for model in comparison.models] == [
        ("cab@1.0.0", "cab@1.0.0"),
        ("rubiz@1.0.0", "rubiz@2.0.0"),
        ("physics-oracle", "physics-oracle"),
    ]
    assert comparison.only_a == ("cab@1.1.0", "gone@1.0.0", "covernet@1.0.0", "covernet@1.1.0")
    assert comparison.only_b == ("cab@1.2.0", "cab@1.3.0", "new@1.0.0", "covernet@1.2.0")
    assert "rubiz, version: 1.0.0 in A, 2.0.0 in B" in comparison.remarks
    assert "rubiz, trained by protocol: causal in A, paper in B" in comparison.remarks
    text = markdown(comparison)
    assert "- only in A: cab@1.1.0, gone@1.0.0, covernet@1.0.0, covernet@1.1.0\n" in text
    assert "| rubiz@1.0.0 → rubiz@2.0.0 | FDE-ML 6 s |" in text


def test_another_version_is_compared_pair_by_pair(tmp_path: Path) -> None:
    later = made_results(made_model("cab", "1.1.0"))
    comparison = compare(
        saved(tmp_path / "a", made_results(), {FDE: np.full(PAIRS, 3.0)}),
        saved(tmp_path / "b", later, {"cab@1.1.0/fde_ml_6s_m": np.full(PAIRS, 1.0)}),
    )
    found = difference(comparison, "FDE-ML 6 s")
    assert (found.difference, found.pairs) == (-2.0, PAIRS)


def test_a_figure_that_one_run_lacks_is_a_dash(tmp_path: Path) -> None:
    fewer = {name: value for name, value in made_metrics().items() if name != "dispersion_std_m"}
    comparison = two(tmp_path, made_results(), made_results(made_model(metrics=fewer)))
    row = next(line for line in table(comparison).rows if line[1] == "D, std")
    assert row[2:] == ("2.000", "-", "-", "-", "-", "0", "unknown")


def test_nothing_in_common(tmp_path: Path) -> None:
    comparison = two(tmp_path, made_results(), made_results(made_model("rubiz")))
    assert comparison.models == ()
    assert "|" not in markdown(comparison)


def test_a_folder_without_results_is_named(tmp_path: Path) -> None:
    folder = saved(tmp_path / "a", made_results())
    empty = tmp_path / "b"
    empty.mkdir()
    with pytest.raises(BenchmarkError, match=re.escape(str(empty / RESULTS_FILE))):
        compare(folder, empty)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"models": [{"metrics": null}]}', '{"models": [3]}'])
def test_what_are_no_results_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "results.json").write_text(text)
    with pytest.raises(BenchmarkError, match=r"results\.json: not a benchmark's results"):
        compare(tmp_path, tmp_path)


def test_figures_that_are_cut_short_are_named(tmp_path: Path) -> None:
    made_results().write(tmp_path)
    Instances({"cab@1.0.0/nll": np.zeros(10)}).write(tmp_path)
    file = tmp_path / "instances.npz"
    file.write_bytes(file.read_bytes()[:-30])
    with pytest.raises(BenchmarkError, match=r"instances\.npz: cannot be read"):
        compare(tmp_path, tmp_path)


def test_figures_of_another_number_of_pairs_are_refused(tmp_path: Path) -> None:
    a = saved(tmp_path / "a", made_results(), {FDE: np.zeros(PAIRS)})
    b = saved(tmp_path / "b", made_results(), {FDE: np.zeros(PAIRS - 1)})
    with pytest.raises(BenchmarkError, match=INSTANCES_FILE):
        compare(a, b)


def test_a_difference_of_one_scene_alone_is_not_clear(tmp_path: Path) -> None:
    """More than two standard errors of independent pairs, but zero in half of the scenes."""
    scenes = np.repeat([0, 1], PAIRS // 2)
    a = np.zeros(PAIRS)
    comparison = compare(
        saved(tmp_path / "a", made_results(), {FDE: a}, scenes),
        saved(tmp_path / "b", made_results(), {FDE: a + scenes}, scenes),
    )
    found = difference(comparison, "FDE-ML 6 s")
    assert found.difference > 2 * found.standard_error > 0
    assert found.interval == (0.0, 1.0)
    assert found.clear is False
    row = next(line for line in table(comparison).rows if line[1] == "FDE-ML 6 s")
    assert row[4:] == ("+0.500", "0.167", "+0.000 … +1.000", "10", "no")
    assert "2000 resamples, seed 0" in table(comparison).note


def test_scenes_that_one_run_recorded_serve_both(tmp_path: Path) -> None:
    """Files of older versions hold none."""
    comparison = compare(
        saved(tmp_path / "a", made_results(), {FDE: np.zeros(PAIRS)}),
        saved(tmp_path / "b", made_results(), {FDE: np.full(PAIRS, 2.0)}, np.arange(PAIRS)),
    )
    assert difference(comparison, "FDE-ML 6 s").interval == (2.0, 2.0)
    assert difference(comparison, "FDE-ML 6 s").clear
    assert Instances.read(tmp_path / "a", PAIRS).scenes is None
    np.testing.assert_array_equal(Instances.read(tmp_path / "b", PAIRS).scenes, np.arange(PAIRS))
