"""Batches against the features that are made one scene at a time."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from model.arrays import Floats
from model.data.batches import Batches
from model.data.cache import Cache
from model.data.cache_builder import build_cache
from model.data.protocols import frame_scene
from model.data.scenes import DataError, SceneRecord
from model.features.scene_features import ground_frame_features
from model.forecaster import Context, Protocol, join
from model.networks.config import CoverNetConfig, NetworkConfig
from model.networks.covernet import present_heading
from model.networks.covernet import turned as turned_vectors
from model.scenes.scene import AgentType
from tests.model.data.records import FixedReader, raster, record, turned

CONFIG = NetworkConfig()
PATCH_TOLERANCE = 2e-4
"""grid_sample's own: its float32 coordinates are relative to the raster, not to the agent."""
CPU = torch.device("cpu")
DEVICES = [
    "cpu",
    pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")),
]

EDGE = raster(120, 90, origin=(990.0, 1985.0), seed=3)
"""Agents leave it on all sides."""
AWAY = raster(30, 40, origin=(-5e6, 3000.0), seed=4)
"""Nobody is on it."""
RECORDS = (
    record("scene-1", seed=1),
    replace(record("scene-2", seed=2), raster=raster(300, 200, scale=2.5)),
    replace(record("scene-3", seed=3), raster=EDGE),
    replace(record("scene-4", seed=4), raster=AWAY),
    turned(record("scene-5", seed=5), 2.0, (1000.0, 2000.0)),
    replace(record("scene-6", seed=6), raster=raster(1, 1, origin=(1000.0, 2000.0))),
)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Cache:
    folder = tmp_path_factory.mktemp("caches") / "cache"
    build_cache(FixedReader(*RECORDS), "some", Protocol.CAUSAL, CONFIG, 5, folder)
    return Cache.open(folder)


def _exact(whole: SceneRecord, position: Floats, heading: float) -> Floats:
    """Return one patch in [-1, 1], bilinear in float64."""
    picture, (cos, sin) = whole.raster, (np.cos(heading), np.sin(heading))
    zoom = picture.pixels_per_meter / 3.0
    ahead, left = zoom * (np.arange(100)[:, None] - 10.0), zoom * (np.arange(100)[None, :] - 50.0)
    center = (position - picture.origin) * picture.pixels_per_meter
    row, column = center[0] + ahead * cos - left * sin, center[1] + ahead * sin + left * cos
    padded = np.pad(picture.layers.astype(np.float64), ((0, 0), (1, 1), (1, 1)))
    row = np.clip(row, -1, picture.layers.shape[1]) + 1
    column = np.clip(column, -1, picture.layers.shape[2]) + 1
    i = np.minimum(row.astype(int), padded.shape[1] - 2)
    j = np.minimum(column.astype(int), padded.shape[2] - 2)
    u, v = row - i, column - j
    near = (1 - v) * padded[:, i, j] + v * padded[:, i, j + 1]
    far = (1 - v) * padded[:, i + 1, j] + v * padded[:, i + 1, j + 1]
    patch: Floats = 2 * ((1 - u) * near + u * far) - 1
    return patch


@pytest.mark.parametrize("device", DEVICES)
def test_they_are_the_features_of_each_scene(cache: Cache, device: str) -> None:
    batches = Batches(cache, torch.device(device))
    indices = torch.randperm(len(cache), generator=torch.Generator().manual_seed(0))
    features, future = batches.features(indices)
    parts = []
    for row in indices.tolist():
        whole = RECORDS[int(cache.scene[row])]
        scene, tracks = frame_scene(whole, int(cache.frame[row]), Protocol.CAUSAL, 5)
        target = np.flatnonzero(tracks == cache.track[row])
        parts.append(ground_frame_features(scene, target, AgentType.VEHICLE, CONFIG.features, Context.FULL))
    wanted = join(parts)
    assert features.keys() == wanted.keys()
    for name, value in wanted.items():
        tolerance = PATCH_TOLERANCE if name == "map" else 1e-5
        torch.testing.assert_close(features[name].cpu(), value, rtol=1e-5, atol=tolerance)
        assert features[name].device.type == device
    torch.testing.assert_close(future.cpu(), torch.from_numpy(cache.future[indices.numpy()]))
    assert (wanted["map"] > 0).any(dim=(1, 2, 3)).sum() > 60


@pytest.mark.parametrize("device", DEVICES)
def test_patches_are_exact_to_a_hundred_thousandth_of_a_pixel(cache: Cache, device: str) -> None:
    rows = torch.arange(len(cache))
    patches = Batches(cache, torch.device(device)).features(rows)[0]["map"].cpu().numpy()
    for row in rows.tolist():
        whole = RECORDS[int(cache.scene[row])]
        exact = _exact(whole, cache.position[row], float(cache.heading[row]))
        # Two per pixel and axis
        np.testing.assert_allclose(patches[row], exact, atol=4e-5)


def test_off_the_map_there_is_nothing(cache: Cache) -> None:
    rows = torch.from_numpy(np.flatnonzero(cache.scene == 3))
    assert (Batches(cache, CPU).features(rows)[0]["map"] == -1).all()


def test_any_number_of_pairs_in_any_order(cache: Cache) -> None:
    batches = Batches(cache, CPU)
    assert len(batches) == len(cache)
    whole, _ = batches.features(torch.arange(len(cache)))
    some = torch.tensor([7, 3, 3, 40])
    features, future = batches.features(some)
    for name, value in features.items():
        torch.testing.assert_close(value, whole[name][some])
    assert future.shape == (4, 12, 2)
    none, _ = batches.features(torch.zeros(0, dtype=torch.int64))
    assert none["map"].shape == (0, 3, 100, 100)
    assert none["history"].shape == (0, 5, 8)


def test_a_network_that_sees_less_gets_less(cache: Cache) -> None:
    blind = Batches(cache, CPU, NetworkConfig(neighbor_types=(), uses_map=False))
    features, _ = blind.features(torch.arange(2))
    assert features.keys() == {"origin", "velocity", "history", "first"}
    with pytest.raises(DataError, match="neighbours"):
        Batches(cache, CPU, NetworkConfig(neighbor_types=(AgentType.VEHICLE,)))


def test_batches_with_boxes(cache: Cache, tmp_path: Path) -> None:
    config = CoverNetConfig()
    build_cache(FixedReader(*RECORDS[:2]), "some", Protocol.CAUSAL, config, 5, tmp_path / "cache")
    drawn = Cache.open(tmp_path / "cache")
    batches = Batches(drawn, CPU, config)
    rows = torch.arange(len(drawn))
    plain, future = batches.batch(rows)
    assert plain.keys() == {"origin", "velocity", "history", "first", "neighbor_boxes", "map"}
    turned_features, turned_future = batches.batch(rows, torch.full((len(rows),), 2.0))
    torch.testing.assert_close(turned_features["neighbor_boxes"], plain["neighbor_boxes"])
    # In the agents' own frames the futures are what they were
    for features, truth in ((plain, future), (turned_features, turned_future)):
        own = turned_vectors(truth, -present_heading(features))
        torch.testing.assert_close(own, batches.paths, rtol=1e-4, atol=1e-4)
    with pytest.raises(DataError, match="boxes"):
        Batches(drawn, CPU, NetworkConfig())
    with pytest.raises(DataError, match="summed histories"):
        Batches(cache, CPU, config)


def test_turned_batches(cache: Cache) -> None:
    batches = Batches(cache, CPU)
    rows = torch.arange(5)
    plain, future = batches.batch(rows)
    same, _ = batches.features(rows)
    assert all(torch.equal(plain[name], same[name]) for name in same)
    turned_features, turned_future = batches.batch(rows, torch.full((5,), np.pi))
    torch.testing.assert_close(turned_future, -future, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(turned_features["velocity"], -plain["velocity"], atol=1e-5, rtol=1e-5)
    assert torch.equal(turned_features["map"], plain["map"])
    torch.testing.assert_close(batches.turned, torch.from_numpy(np.array(cache.turn)))


def test_batches_are_their_own_memory(cache: Cache) -> None:
    batches = Batches(cache, CPU)
    features, future = batches.features(torch.arange(3))
    for value in (*features.values(), future):
        value.zero_()
    again, _ = batches.features(torch.arange(3))
    assert again["history"].any()
