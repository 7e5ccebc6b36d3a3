"""Augmentation by hiding: parts of the context that a call may lack are taken away at random."""

from typing import Final

import torch

from model.data.packing import UNKNOWN
from model.forecaster import Features

NO_MAP: Final = 0.04
"""Share of the agents without any map,"""
NO_FAR_MAP: Final = 0.08
"""without a far map patch,"""
NO_NEAR_MAP: Final = 0.03
"""without a near one,"""
SHORT_MAP: Final = 0.08
"""with a map that ends at a random distance ahead,"""
NO_NEIGHBORS: Final = 0.04
"""and without neighbours."""


def hide_context(features: Features) -> Features:
    """Return features in which some agents lack a map, a part of it, or their neighbours.

    Args:
        features: in the agents' frames (``model.features.agent_features``), maps packed (``Batches``); left
            as they
            are.
    """
    hidden = dict(features)
    count = len(features["history"])
    device = features["history"].device
    none, short = (torch.rand(count, device=device) < share for share in (NO_MAP, SHORT_MAP))
    for name, share in (("map", NO_NEAR_MAP), ("far_map", NO_FAR_MAP)):
        if name not in features:
            continue
        gone = none | (torch.rand(count, device=device) < share)
        patches = features[name].clone()
        patches[gone] = UNKNOWN
        size = patches.shape[1]
        for row in (short & ~gone).nonzero()[:, 0].tolist():
            patches[row, int(torch.randint(size // 4, size, ())) :] = UNKNOWN
        hidden[name] = patches
    if "neighbors" in features:
        alone = torch.rand(count, device=device) < NO_NEIGHBORS
        hidden["neighbors"] = features["neighbors"] * ~alone[:, None, None]
    return hidden
