"""Context ablation: features of which the map, the neighbours or both are removed.

A removed part counts as unknown, as in CAB's blind forecast (REFERENCE, section 3): the map is zero after
scaling, midway between absent and present; there are no neighbours.
"""

from collections.abc import Callable, Mapping
from enum import StrEnum

import torch

from model.forecaster import Features, ModelInfo

_NEIGHBORS = ("neighbors", "edge_mask", "neighbor_boxes")
"""Names of the neighbours' features, up to the dot; all zeros mean that there are none."""
_MAPS = frozenset({"map", "far_map"})


class Without(StrEnum):
    """The part of the context that is removed."""

    MAP = "map"
    NEIGHBORS = "neighbors"
    BOTH = "both"


def without_map(features: Features) -> Features:
    """Return the features with a null map.

    Args:
        features: features of ``model.features.scene_features``; ``map`` and, where present, ``far_map``
            [N, 3, 100, 100] in [-1, 1].
    """
    return features | {name: torch.zeros_like(features[name]) for name in _MAPS & features.keys()}


def without_neighbors(features: Features) -> Features:
    """Return the features of agents without neighbours.

    Args:
        features: features of ``model.features.scene_features``; ``neighbors.<type>`` [N, F, D] and
            ``edge_mask`` [N], or ``neighbors`` [N, M, 11], or ``neighbor_boxes`` [N, S, 5].
    """
    removed = [name for name in features if name.partition(".")[0] in _NEIGHBORS]
    return features | {name: torch.zeros_like(features[name]) for name in removed}


def without_both(features: Features) -> Features:
    """Return the features with neither map nor neighbours."""
    return without_neighbors(without_map(features))


def ablations(info: ModelInfo) -> Mapping[Without, Callable[[Features], Features]]:
    """Return the ablations of a model: only of what it uses."""
    if info.uses_map and info.uses_neighbors:
        return {Without.MAP: without_map, Without.NEIGHBORS: without_neighbors, Without.BOTH: without_both}
    if info.uses_map:
        return {Without.MAP: without_map}
    return {Without.NEIGHBORS: without_neighbors} if info.uses_neighbors else {}
