"""Agents that wait for a forward: what is joined, and when patches are cut."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

from model.forecaster import Prepared, complete
from model.scenes.raster import FAR, NEAR, map_view
from model.scenes.scene import Raster
from tests.model.made_scenes import crowd

VEHICLES = np.array([0, 1, 2])


def prepared(agents: int, first: int) -> Prepared:
    """Agents that see two views of the map, numbered from ``first``."""
    layers = np.random.default_rng(first).integers(0, 2, (3, 80, 90), dtype=np.uint8)
    scene = replace(crowd(), raster=Raster(layers, np.array([-15.0, -15.0]), 3.0))
    targets = VEHICLES[np.arange(agents) % len(VEHICLES)]
    numbers = first + torch.arange(agents)
    views = {
        "map": map_view(scene, targets, {}, NEAR, 0.5),
        "far_map": map_view(scene, targets, {}, FAR, 0.5),
    }
    return Prepared({"number": numbers}, views)


@pytest.mark.parametrize("sizes", [(3,), (1, 1, 40, 2, 1), (33, 33), (1, 0, 1)])
@pytest.mark.parametrize("threaded", [False, True])
def test_agents_of_many_scenes_are_joined_in_order(sizes: tuple[int, ...], threaded: bool) -> None:
    parts = [prepared(size, 100 * place) for place, size in enumerate(sizes)]
    with ThreadPoolExecutor(2) as threads:
        features = complete(parts, threads if threaded else None)
    assert features.keys() == {"number", "map", "far_map"}
    numbers = [100 * place + index for place, size in enumerate(sizes) for index in range(size)]
    assert features["number"].tolist() == numbers
    for name in ("map", "far_map"):
        each = np.concatenate([part.views[name].cut() for part in parts])
        np.testing.assert_allclose(features[name].numpy(), each, atol=2e-3)


def test_features_without_a_map_are_joined_as_they_are() -> None:
    parts = [Prepared({"number": torch.arange(count)}) for count in (2, 3)]
    assert complete(parts)["number"].tolist() == [0, 1, 0, 1, 2]


def test_successive_agents_keep_their_views() -> None:
    whole = prepared(5, 0)
    part = whole[2:4]
    assert len(part) == 2
    assert part.features["number"].tolist() == [2, 3]
    np.testing.assert_allclose(part.views["map"].cut(), whole.views["map"].cut()[2:4], atol=1e-5)
