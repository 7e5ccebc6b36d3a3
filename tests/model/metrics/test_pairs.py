import numpy as np
import pytest
import torch

from model.metrics.evaluate import instance_metrics
from model.metrics.oracle import PHYSICS
from model.metrics.pairs import SEED_STRIDE, EvaluatedPairs, Sampling
from model.mixture import TrajectoryMixture
from model.scenes.scene import Raster
from tests.model.metrics.builders import random_mixture

ROADS = [Raster(np.full((3, 4, 4), value, dtype=np.uint8), np.zeros(2), 3.0) for value in (0, 1, 1, 0)]
MIXTURE = random_mixture(0, 4, 3)
TRUTH = MIXTURE.most_likely_trajectory().numpy() + 1.0
PAIRS = EvaluatedPairs(np.arange(10, 14), TRUTH, ROADS, np.array([False, True, False, False]))


def test_metrics_are_those_of_single_pairs_whatever_the_batch() -> None:
    whole = PAIRS.metrics(MIXTURE, Sampling(20, 9, seed=2))
    expected = instance_metrics(
        MIXTURE,
        TRUTH,
        ROADS,
        [number + 2 * SEED_STRIDE for number in range(10, 14)],
        samples=20,
        draws=9,
        stood=PAIRS.stood,
    )
    assert whole.keys() == expected.keys()
    rows = np.array([1, 3])
    some = PAIRS[rows].metrics(MIXTURE[torch.from_numpy(rows)], Sampling(20, 9, seed=2))
    for name, values in whole.items():
        np.testing.assert_array_equal(values, expected[name], name)
        np.testing.assert_allclose(some[name], values[rows], rtol=1e-6, err_msg=name)
    assert len(PAIRS[rows]) == 2
    other = PAIRS.metrics(MIXTURE, Sampling(20, 9, seed=3))
    assert (other["fde_f_6s_m"] != whole["fde_f_6s_m"]).all()


def test_without_draws_there_are_no_such_metrics() -> None:
    names = PAIRS.metrics(MIXTURE, Sampling(0, 0)).keys()
    assert "fde_ml_6s_m" in names
    assert not {"fde_f_6s_m", "inside_90"} & names


def test_the_oracle_is_the_nearest_of_the_four_physics_baselines() -> None:
    forward = torch.from_numpy(TRUTH)[:, None] - MIXTURE.origin[:, None, None]
    physics = {
        name: TrajectoryMixture(torch.zeros(4, 1), forward + off, MIXTURE.covariances[:, :1], MIXTURE.origin)
        for name, off in zip(PHYSICS, (3.0, 1.0, 2.0, 4.0), strict=True)
    }
    found = PAIRS.oracle_metrics(physics)
    np.testing.assert_allclose(found["fde_ml_6s_m"], np.sqrt(2.0), rtol=1e-5)
    assert np.isnan(found["moving_fde_ml_6s_m"]).tolist() == [False, True, False, False]
    assert "nll" not in found
    with pytest.raises(KeyError):
        PAIRS.oracle_metrics({name: physics[name] for name in PHYSICS[:3]})
