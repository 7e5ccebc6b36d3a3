from pathlib import Path

import numpy as np
import pytest
import torch

from model.baselines import physics
from model.baselines.kalman import Kalman
from model.baselines.unimodal import unimodal
from model.data.cache import Cache
from model.data.cache_builder import build_cache
from model.data.protocols import frame_scene
from model.data.scenes import DataError, Pair, SceneRecord
from model.evaluation.in_process import evaluate_baselines, scene_features
from model.evaluation.pairs import split_pairs
from model.forecaster import Protocol
from model.metrics.evaluate import instance_metrics
from model.metrics.oracle import ORACLE, PHYSICS, oracle_mixture
from model.metrics.pairs import Sampling
from model.networks.config import NetworkConfig
from tests.model.data.records import FixedReader, raster, record, track

READER = FixedReader(record(), record("scene-2", seed=1))
NO_DRAWS = Sampling(0, 0)
COVARIANCES = torch.eye(2).expand(2, 2, 2, 2)


def test_the_oracle_chooses_for_each_pair_by_hand() -> None:
    """Two pairs of two steps; the errors' means are 2, 1, 3, 4 m and 4, 3, 2, 2 m (of equals the first)."""
    off = {
        "constant-velocity-yaw": [[1, 3], [4, 4]],
        "constant-speed-yaw-rate": [[2, 0], [1, 5]],
        "constant-acceleration-yaw": [[3, 3], [2, 2]],
        "constant-acceleration-yaw-rate": [[4, 4], [0, 4]],
    }
    origin = torch.tensor([[10.0, 20.0], [-5.0, 0.0]], dtype=torch.float64)
    mixtures = {
        name: unimodal(torch.tensor([[[0.0, e] for e in row] for row in errors]), COVARIANCES, origin)
        for name, errors in off.items()
    }
    truth = np.repeat(origin.numpy()[:, None], 2, axis=1)
    best = oracle_mixture(mixtures, truth)
    assert best.means[:, 0].tolist() == [[[0, 2], [0, 0]], [[0, 2], [0, 2]]]
    assert torch.equal(best.origin, origin)
    metrics = instance_metrics(oracle_mixture(mixtures, truth), truth)
    assert metrics["ade_ml_1s_m"].tolist() == [1.0, 2.0]


def test_pairs_come_in_the_order_of_the_cache(tmp_path: Path) -> None:
    build_cache(READER, "some", Protocol.CAUSAL, NetworkConfig(), 5, tmp_path / "cache")
    cache = Cache.open(tmp_path / "cache")
    scenes = list(split_pairs(READER, "some"))
    truth = np.concatenate([scene.evaluated().truth for scene in scenes])
    np.testing.assert_allclose(truth, cache.future + cache.position[:, None], atol=1e-4)
    features = [scene_features(scene, Protocol.CAUSAL, [Kalman()])[0] for scene in scenes]
    origin = np.concatenate([one["origin"].numpy() for one in features])
    np.testing.assert_array_equal(origin, cache.position)


@pytest.mark.parametrize("protocol", Protocol)
def test_figures_are_the_means_over_single_forecasts(protocol: Protocol) -> None:
    kalman = Kalman()
    means = evaluate_baselines(READER, "some", protocol, [kalman], False, Sampling(10, 9))
    parts: dict[str, list[float]] = {}
    number = 0
    for one in READER.scenes("some"):
        for pair in one.pairs:
            scene, tracks = frame_scene(one, pair.frame, protocol, 5)
            target = np.flatnonzero(tracks == pair.track)
            now = int(np.searchsorted(one.tracks[pair.track].frames, pair.frame))
            truth = one.tracks[pair.track].position[None, now + 1 : now + 13]
            forecast = kalman(scene, target)
            stood = one.stood([pair])
            metrics = instance_metrics(
                forecast, truth, [one.raster], [number], samples=10, draws=9, stood=stood
            )
            for name, (value,) in metrics.items():
                parts.setdefault(name, []).append(value)
            number += 1
    assert list(means) == ["kalman@1.0.0"]
    found = means["kalman@1.0.0"].means()
    assert found.keys() == parts.keys()
    for name, values in parts.items():
        assert found[name] == pytest.approx(np.nanmean(values), rel=1e-5, abs=1e-5), name


def test_the_oracle_is_no_worse_than_any_and_states_no_density() -> None:
    means = evaluate_baselines(READER, "some", Protocol.CAUSAL, physics.baselines(), True, NO_DRAWS)
    oracle = means.pop(ORACLE).means()
    assert {name.partition("@")[0] for name in means} == set(PHYSICS)
    assert all(oracle["ade_ml_6s_m"] <= one.mean("ade_ml_6s_m") for one in means.values())
    assert {name.rpartition("_ml")[0] for name in oracle} == {
        *("ade", "fde", "off_road"),
        *("moving_ade", "moving_fde", "moving_off_road"),
    }


def straight() -> SceneRecord:
    """One car at 10 m/s along x on a road that ends 20 m ahead of it; two pairs."""
    road = raster(300, 30, (-30.0, -5.0), 3.0)
    road.layers[0] = 1
    position = np.stack([5.0 * np.arange(20) - 20, np.zeros(20)], axis=1)
    return SceneRecord("scene-1", [track("a", position)], [Pair(0, 4), Pair(0, 5)], road)


def test_a_car_that_goes_straight_on_is_foreseen() -> None:
    means = evaluate_baselines(
        FixedReader(straight()), "some", Protocol.CAUSAL, physics.baselines(), True, NO_DRAWS
    )
    for one in means.values():
        assert one.mean("fde_ml_6s_m") == pytest.approx(0, abs=1e-4)
        assert one.count("fde_ml_6s_m") == 2


def test_a_limit_takes_the_first_pairs() -> None:
    done: list[int] = []
    first = len(record().pairs)
    means = evaluate_baselines(
        READER, "some", Protocol.CAUSAL, [Kalman()], False, NO_DRAWS, first + 3, tick=done.append
    )
    assert done == [first, first + 3]
    assert means["kalman@1.0.0"].count("ade_ml_6s_m") == first + 3
    evaluate_baselines(READER, "some", Protocol.CAUSAL, [Kalman()], False, NO_DRAWS, first, tick=done.append)
    assert done[2:] == [first]


def test_a_split_without_pairs() -> None:
    with pytest.raises(DataError, match="'none' has no pairs"):
        evaluate_baselines(READER, "none", Protocol.CAUSAL, [Kalman()], False, NO_DRAWS)
