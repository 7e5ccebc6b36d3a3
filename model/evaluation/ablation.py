"""Does the context matter? Forecasts from features of which a part is taken away.

What is taken away counts as unknown, as for CAB's blind forecast (REFERENCE, section 3): the map is zero
after scaling, midway between absent and present; there are no neighbours.
"""

from collections.abc import Callable, Mapping
from enum import StrEnum

import torch

from model.forecaster import Features, ModelInfo

_NEIGHBORS = ("neighbors", "edge_mask", "neighbor_boxes")
"""Features that tell of them, up to the dot; zero means that there are none."""


_MAPS = frozenset({"map", "far_map"})


class Without(StrEnum):
    """What is taken away."""

    MAP = "map"
    NEIGHBORS = "neighbors"
    BOTH = "both"


def without_map(features: Features) -> Features:
    """The features with the null map.

    Args:
        features: of ``model.features.scene_features``; ``map`` and, where there is one, ``far_map`` [N, 3,
            100, 100] in
            [-1, 1].
    """
    return features | {name: torch.zeros_like(features[name]) for name in _MAPS & features.keys()}


def without_neighbors(features: Features) -> Features:
    """The features of agents that are alone.

    Args:
        features: of ``model.features.scene_features``; ``neighbors.<type>`` [N, F, D] and ``edge_mask`` [N],
            or
            ``neighbors`` [N, M, 11], or ``neighbor_boxes`` [N, S, 5].
    """
    gone = [name for name in features if name.partition(".")[0] in _NEIGHBORS]
    return features | {name: torch.zeros_like(features[name]) for name in gone}


def without_both(features: Features) -> Features:
    """The features with neither map nor neighbours."""
    return without_neighbors(without_map(features))


def ablations(info: ModelInfo) -> Mapping[Without, Callable[[Features], Features]]:
    """What can be taken away from a model: of one that does not look at it, nothing."""
    if info.uses_map and info.uses_neighbors:
        return {Without.MAP: without_map, Without.NEIGHBORS: without_neighbors, Without.BOTH: without_both}
    if info.uses_map:
        return {Without.MAP: without_map}
    return {Without.NEIGHBORS: without_neighbors} if info.uses_neighbors else {}
