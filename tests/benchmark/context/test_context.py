"""The measures of the use of the context, on scenes where it is known who uses it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmark.archive import Archive
from benchmark.context import ContextSettings
from benchmark.errors import BenchmarkError
from benchmark.results import BenchmarkResults, Estimate, Instances, subset_figure
from benchmark.run import Benchmark, run_benchmark
from model.baselines.kalman import baselines
from model.forecaster import Forecaster, Protocol
from model.metrics.pairs import Sampling
from tests.benchmark.context.worlds import WORLDS, Follower
from tests.model.data.records import FixedReader

BOTH = Follower("both", uses_map=True, uses_neighbors=True)
MAP = Follower("map", uses_map=True, uses_neighbors=False)
NEIGHBORS = Follower("neighbors", uses_map=False, uses_neighbors=True)
NEITHER = Follower("neither", uses_map=False, uses_neighbors=False)
SETTINGS = ContextSettings(donors=2, no_context="neither")


def made(folder: Path, settings: ContextSettings | None = SETTINGS, seed: int = 0) -> Benchmark:
    """A benchmark of the made-up scenes."""
    reader = FixedReader(*WORLDS)
    sampling = Sampling(0, 0, seed)
    return Benchmark(
        "made", reader, "some", Protocol.CAUSAL, folder, sampling, consistency=False, context=settings
    )


def run(folder: Path, *forecasters: Forecaster, seed: int = 0) -> BenchmarkResults:
    """Results of a benchmark in this process."""
    return run_benchmark(made(folder, seed=seed), forecasters, folder).results


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> BenchmarkResults:
    """Results of all four."""
    return run(tmp_path_factory.mktemp("run"), BOTH, MAP, NEIGHBORS, NEITHER)


def measures(results: BenchmarkResults, name: str, subset: str = "all") -> dict[str, Estimate]:
    """The measures of a model."""
    (found,) = (model for model in results.models if model.name == name)
    return dict(found.context[subset])


def test_who_follows_the_map_gains_by_it(results: BenchmarkResults) -> None:
    found = measures(results, "both")
    assert found["gain_m"].low > 5
    assert found["map_advantage_m"].low > 5
    assert found["neighbors_advantage_m"].low > 3
    assert found["map_control_m"].value == pytest.approx(0, abs=1e-3)
    assert found["map_control_size_m"].value == pytest.approx(0, abs=1e-3)
    assert found["compliance"] == Estimate(1.0, 1.0, 1.0, len(WORLDS))


def test_who_looks_at_one_of_them_has_the_advantage_of_that_one(results: BenchmarkResults) -> None:
    assert measures(results, "map")["map_advantage_m"].low > 5
    assert measures(results, "map")["neighbors_advantage_m"].value == pytest.approx(0, abs=1e-3)
    assert measures(results, "neighbors")["neighbors_advantage_m"].value > 3
    assert measures(results, "neighbors")["map_advantage_m"].value == pytest.approx(0, abs=1e-3)


def test_who_is_blind_has_neither_gain_nor_advantage(results: BenchmarkResults) -> None:
    for name, found in measures(results, "neither").items():
        assert (found.value, found.low, found.high) == (0, 0, 0), name


def test_physics_baselines_are_not_asked_again(tmp_path: Path) -> None:
    """They see no context, so that in any case they forecast as with the own one."""
    (kalman,) = baselines()
    results = run(tmp_path, NEITHER, kalman)
    assert results.context is not None
    assert results.context.timed == results.context.cases
    assert results.missing == 0
    found = measures(results, "kalman")
    assert found["gain_m"].pairs == found["map_advantage_m"].pairs == len(WORLDS)
    for name in ("map_advantage_m", "neighbors_advantage_m", "map_control_m", "map_control_size_m"):
        assert (found[name].value, found[name].low, found[name].high) == (0, 0, 0), name


def test_physics_baselines_alone_are_measured_from_their_own_forecasts(tmp_path: Path) -> None:
    (kalman,) = baselines()
    settings = ContextSettings(donors=2, no_context="kalman")
    results = run_benchmark(made(tmp_path, settings), [kalman], tmp_path).results
    assert results.context is not None
    assert results.context.timed == 0
    assert measures(results, "kalman")["gain_m"].value == 0


def test_turns_that_begin_after_now_are_measured_apart(results: BenchmarkResults) -> None:
    turned = [np.ptp(np.unwrap(world.tracks[0].heading)) for world in WORLDS]
    count = sum(angle >= np.deg2rad(30) for angle in turned)
    assert 0 < count < len(WORLDS)
    assert measures(results, "both", "turns after now")["gain_m"].pairs == count


def test_equal_seeds_give_equal_figures(tmp_path: Path, results: BenchmarkResults) -> None:
    again = run(tmp_path / "again", BOTH, NEITHER)
    assert measures(again, "both") == measures(results, "both")
    other = run(tmp_path / "other", BOTH, NEITHER, seed=1)
    assert measures(other, "both")["gain_m"] == measures(results, "both")["gain_m"]
    assert measures(other, "both")["map_advantage_m"] != measures(results, "both")["map_advantage_m"]


def test_results_are_written_and_read(tmp_path: Path) -> None:
    results = run(tmp_path, BOTH, NEITHER)
    assert BenchmarkResults.read(tmp_path) == results
    assert results.context is not None
    assert (results.context.no_context, results.context.donors) == ("neither@1.0.0", 2)
    assert results.context.timed == 2 * results.context.cases == 60
    assert "9. Use of the context" in (tmp_path / "tables.md").read_text()
    with np.load(tmp_path / "instances.npz") as each:
        assert each["both@1.0.0/map_advantage_m"].mean() == pytest.approx(
            measures(results, "both")["map_advantage_m"].value
        )
    held = Instances.read(tmp_path, results.pairs)
    for subset in ("all", "turns after now"):
        for name, found in measures(results, "both", subset).items():
            ratio = held.ratio("both@1.0.0", subset_figure(name, subset))
            assert ratio is not None
            assert ratio.sums.sum() / ratio.divisors.sum() == pytest.approx(found.value), (subset, name)
    saved = run_benchmark(made(tmp_path), None, tmp_path / "saved").results
    assert saved == results


def test_the_model_without_context_may_be_of_another_run(tmp_path: Path, results: BenchmarkResults) -> None:
    with pytest.raises(BenchmarkError, match="need forecasts of 'neither': ask it, too"):
        run(tmp_path / "both", BOTH)
    run_benchmark(made(tmp_path / "neither", None), [NEITHER], tmp_path / "neither")
    whole = made(tmp_path / "both", replace(SETTINGS, no_context_answers=tmp_path / "neither"))
    found = run_benchmark(whole, [BOTH], tmp_path / "both").results
    assert measures(found, "both") == measures(results, "both")


def test_a_lost_forecast_is_missed(tmp_path: Path) -> None:
    whole = made(tmp_path)
    run_benchmark(whole, [BOTH, NEITHER], tmp_path)
    with Archive(tmp_path / "context") as archive:
        archive._file.execute("DELETE FROM answers WHERE model = 'both@1.0.0' AND scene = 'control-0/2'")
    found = run_benchmark(whole, None, tmp_path).results
    assert found.missing == 1
    assert measures(found, "both")["map_control_m"].pairs == len(WORLDS) - 1


def test_answers_of_other_donors_are_refused(tmp_path: Path) -> None:
    run(tmp_path, BOTH, NEITHER)
    with pytest.raises(BenchmarkError, match="donors was 2, is 1"):
        run_benchmark(made(tmp_path, replace(SETTINGS, donors=1)), None, tmp_path)


def test_saved_answers_without_a_changed_context_are_not_enough(tmp_path: Path) -> None:
    run_benchmark(made(tmp_path, None), [BOTH, NEITHER], tmp_path)
    with pytest.raises(BenchmarkError, match=r"context/answers\.sqlite: there are no saved answers"):
        run_benchmark(made(tmp_path), None, tmp_path)
