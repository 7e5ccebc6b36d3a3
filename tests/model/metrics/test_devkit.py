"""Comparison with nuscenes-devkit itself, where it is installed (not beside the rest: it needs numpy < 2)."""

import importlib
import warnings
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from model.arrays import Floats
from model.metrics import displacement, multimodal
from model.metrics.offroad_devkit import off_road_rate_devkit
from model.metrics.oracle import Criterion, physics_oracle
from tests.model.metrics.builders import raster

KS = (1, 5, 10)


@pytest.fixture(scope="module")
def devkit() -> ModuleType:
    """Return the module nuscenes.eval.prediction.metrics."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its dependencies'
        return _import("nuscenes.eval.prediction.metrics", "nuscenes-devkit is not installed")


def _import(name: str, reason: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pytest.skip(f"{reason} ({error})")


def _predictions(seed: int, modes: int) -> tuple[Floats, Floats, Floats]:
    """Return modes [20, K, 12, 2], probabilities [20, K], truths [20, 12, 2]."""
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.normal(1, 1, (20, 12, 2)), axis=1) + 400
    noise = np.cumsum(rng.normal(0, 0.3, (20, modes, 12, 2)), axis=2)
    return truth[:, None] + noise, rng.dirichlet(np.ones(modes), 20), truth


@pytest.mark.parametrize("modes", [1, 3, 6, 25])
def test_min_ade_min_fde_and_miss_rate(devkit: ModuleType, modes: int) -> None:
    trajectories, probabilities, truth = _predictions(modes, modes)
    for official, ours in (
        (devkit.MinADEK, multimodal.min_ade_m),
        (devkit.MinFDEK, multimodal.min_fde_m),
        (devkit.MissRateTopK, multimodal.missed),
    ):
        metric = official(list(KS), [])
        for n in range(len(truth)):
            prediction = SimpleNamespace(
                prediction=trajectories[n], probabilities=probabilities[n], number_of_modes=modes
            )
            expected = metric(truth[n], prediction)
            mine = [ours(trajectories[n : n + 1], probabilities[n : n + 1], truth[n : n + 1], k) for k in KS]
            np.testing.assert_allclose(np.stack(mine, axis=1), expected, rtol=1e-12)


def test_equal_probabilities(devkit: ModuleType) -> None:
    trajectories, _, truth = _predictions(1, 8)
    even = np.full((20, 8), 1 / 8)
    stacked = np.repeat(truth[:, None], 8, axis=1)
    ranked = devkit.min_ade_k(trajectories, stacked, even)
    for k in KS:
        mine = multimodal.min_ade_m(trajectories, even, truth, k)
        np.testing.assert_allclose(mine, ranked[:, min(k, 8) - 1], rtol=1e-12)


def test_distances(devkit: ModuleType) -> None:
    trajectories, _, truth = _predictions(2, 4)
    errors = displacement.displacement_m(trajectories, truth[:, None])
    stacked = np.repeat(truth[:, None], 4, axis=1)
    np.testing.assert_allclose(displacement.ade_m(errors, 6), devkit.mean_distances(trajectories, stacked))
    np.testing.assert_allclose(displacement.fde_m(errors, 6), devkit.final_distances(trajectories, stacked))


def test_off_road_rate(devkit: ModuleType) -> None:
    """The devkit's metric on a mask of our making; its rows are our columns."""
    rng = np.random.default_rng(5)
    mask = np.kron(rng.random((40, 60)) > 0.05, np.ones((20, 20))).astype(np.uint8)  # [y, x], 80 m × 120 m
    metric = devkit.OffRoadRate.__new__(devkit.OffRoadRate)
    metric.helper = SimpleNamespace(get_map_name_from_sample_token=lambda _: "map")
    metric.drivable_area_polygons = {"map": mask}
    metric.pixels_per_meter, metric.number_of_points = 10, 200
    ours = raster(np.ascontiguousarray(mask.T), 10.0)
    rates = []
    for n in range(60):
        start = rng.uniform([0, 0], [120, 80])
        modes = start + np.cumsum(rng.normal(rng.normal(0, 1, 2), 0.4, (6, 12, 2)), axis=1)
        modes[0] = start  # one that stands
        rate = off_road_rate_devkit(ours, modes)
        assert rate == metric(modes, SimpleNamespace(prediction=modes, sample="s")).item(), n
        rates.append(rate)
    assert 0.1 < np.mean(rates) < 0.9


def test_off_road_rate_without_scipy() -> None:
    """Trajectories of three distinct points or fewer are looked at as they are."""
    road = raster(np.array([[1, 1], [1, 0]], dtype=np.uint8), 1.0)
    stands, leaves = np.zeros((12, 2)), np.zeros((12, 2))
    leaves[6:] = 1.2
    assert off_road_rate_devkit(road, np.stack([stands, leaves])) == 0.5
    beyond = stands.copy()
    beyond[3:] = [0, 2.0]
    assert off_road_rate_devkit(road, np.stack([beyond])) == 1
    assert off_road_rate_devkit(road, np.stack([stands + 0.99])) == 0  # cut, not rounded
    assert np.isnan(off_road_rate_devkit(road, np.stack([stands, stands * np.nan])))


def test_physics_oracle(devkit: ModuleType) -> None:
    """The devkit's choice, by its own expression (``PhysicsOracle.__call__``)."""
    forecasts, _, truth = _predictions(9, 4)
    chosen = physics_oracle(forecasts, truth, Criterion.RMS_DISTANCE)
    for n in range(len(truth)):
        best = sorted(forecasts[n], key=lambda path: float(np.linalg.norm(path - truth[n], ord="fro")))[0]
        np.testing.assert_array_equal(chosen.trajectory[n], best)
