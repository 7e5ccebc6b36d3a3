"""Augmentation by hold-ups: what the prediction challenge leaves out of a street is put back.

The challenge picks agents that move and hides all others. So in its scenes nobody who stands stays, and
nobody stands in anyone's lane. A network that tells its scenes from others would learn just that.
"""

from typing import Final

import torch
from torch import Tensor

from model.features.agent_features import NEIGHBOR_POSITION_SCALE, NEIGHBOR_REACH_M
from model.forecaster import Features

BLOCKED: Final = 0.12
"""Share of the agents that get somebody standing beyond where they went."""
GAP_M: Final = (6.0, 40.0)
"""m from the end of a path to who stands there, along its last direction: a car's length and more."""
ASIDE_M: Final = 0.5
"""m, standard deviation across that direction."""


def hold(future: Tensor, leaving: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Return futures in which most of those who stood and leave stay.

    Who stood for as long as it was seen had mostly stood before: an earlier pair of the same agent, with the
    same history, ends where it began. The challenge left it out.

    Args:
        future: [N, T, 2], m, relative to now.
        leaving: [N] bool, who stood and leaves.
        share: of those, who leave.
        generator: draws them, on the CPU.
    """
    held = leaving & (torch.rand(len(leaving), generator=generator) >= share)
    return future.masked_fill(held.to(future.device)[:, None, None], 0.0)


def block(features: Features, future: Tensor) -> Features:
    """Return features in which some agents have one more neighbour: a vehicle that stands beyond where they
    went.

    Args:
        features: in the agents' frames, with neighbours; left as they are.
        future: [N, T, 2], m, in the agents' frames, relative to now.
    """
    neighbors = features["neighbors"].clone()
    count, places = neighbors.shape[:2]
    end, moved = future[:, -1], future[:, -1] - future[:, -3]
    # Who hardly moves at the end still faces the way it faces now
    direction = torch.where((moved.norm(dim=-1) > 1.0)[:, None], moved, moved.new_tensor([1.0, 0.0]))
    direction = direction / direction.norm(dim=-1, keepdim=True)
    across = torch.stack([-direction[:, 1], direction[:, 0]], dim=-1)
    gap = GAP_M[0] + (GAP_M[1] - GAP_M[0]) * torch.rand(count, 1, device=end.device)
    place = end + gap * direction + ASIDE_M * torch.randn(count, 1, device=end.device) * across
    free = neighbors[..., -1] <= 0
    chosen = torch.rand(count, device=end.device) < BLOCKED
    chosen &= free.any(dim=1) & (place.norm(dim=-1) < NEIGHBOR_REACH_M)
    rows = chosen.nonzero()[:, 0]
    first = torch.where(free, torch.arange(places, device=end.device), places).amin(dim=1)[rows]
    neighbors[rows, first] = 0.0
    neighbors[rows, first, 0:2] = place[rows] / NEIGHBOR_POSITION_SCALE
    neighbors[rows, first, 2:4] = direction[rows]
    neighbors[rows, first, 8] = 1.0
    neighbors[rows, first, -1] = 1.0
    return features | {"neighbors": neighbors}
