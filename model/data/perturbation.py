"""Perturbations of training pairs: noise, other sizes, missing context, and agents that the data lacks.

- ``jitter`` keeps a network from overfitting details. Each pair is held with a few noisy reports and the map
  patches cut for them. Over many epochs a network learns their very pixels: forecasts then change by metres
  when a raster is drawn anew or turned. A few hundred scenes are also memorised, futures included; in another
  size a scene is another one.
- ``drop_context`` and ``drop_dividers`` take away parts of the context that a request may lack.
- ``keep_standing`` and ``insert_stopped_vehicles`` restore what the prediction challenge leaves out. It
  selects agents that move and hides all others, so that in its scenes no standing agent stays, and none
  stands in anyone's lane. A network that recognises its scenes would learn just that.
"""

from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor

from model.data.packing import UNKNOWN, without_layer
from model.features.agent_features import NEIGHBOR_POSITION_SCALE, NEIGHBOR_REACH_M, PATCHES
from model.forecaster import Features
from model.scenes.raster import PatchGeometry

HISTORY_NOISE: Final = (0.0015, 0.006, 0.007, 0.02, 0.07, 0.07, 0.02, 0.04)
"""Maximum standard deviations of the noise on a history, in its scales: 3 cm, 0.1 m/s, 0.2 to 0.35 m/s²,
0.01 rad, 0.02 rad/s."""
JITTERED: Final = 0.5
"""Share of the agents whose maps are moved."""
MAX_TURN_RAD: Final = 0.015
"""Maximum turn of a map. More would teach that a map does not say where a road is 60 m ahead: 0.05 rad are
3 m there."""
MAX_SHIFT_M: Final = 0.25
MAX_STRETCH: Final = 0.2
"""Maximum share by which scenes are scaled, up or down: positions, speeds, accelerations and maps alike."""
NO_DIVIDERS: Final = 0.1
"""Share of the agents whose maps lack a layer of dividers, for each of the two: many maps have none."""

NO_MAP: Final = 0.04
"""Share of the agents without any map."""
NO_FAR_MAP: Final = 0.08
"""Share without a far map patch."""
NO_NEAR_MAP: Final = 0.03
"""Share without a near map patch."""
SHORT_MAP: Final = 0.08
"""Share with a map that ends at a random distance ahead."""
NO_NEIGHBORS: Final = 0.04
"""Share without neighbours."""

BLOCKED: Final = 0.12
"""Share of the agents with a stopped vehicle inserted beyond where they went."""
GAP_M: Final = (6.0, 40.0)
"""m from the end of a path to the stopped vehicle, along the last direction: a car's length and more."""
LATERAL_OFFSET_M: Final = 0.5
"""m, standard deviation of the stopped vehicle's place across that direction."""


def jitter(features: Features, future: Tensor) -> tuple[Features, Tensor]:
    """Return jittered features and futures.

    Some agents' scenes have another size, and their maps are turned and shifted a little. All agents have
    noise on their histories.

    Args:
        features: features in the agents' frames, maps unpacked; maps are overwritten, the rest is not
            modified.
        future: [N, T, 2], m, in the agents' frames, relative to now; not modified.
    """
    count = len(future)
    size = int((torch.rand(count) < JITTERED).sum())
    # Batches are in random order, so the first or the last are as good as any, and need no copies
    start = (count - size) * int(torch.randint(2, ()))
    chosen = slice(start, start + size)
    stretch = 1.0 + MAX_STRETCH * (2 * torch.rand(size, device=future.device) - 1)
    jittered, future = scaled(features, future, chosen, stretch)
    history = jittered["history"]
    frames = history.shape[1]
    scale = torch.rand(count, 1, 1, device=history.device) * history.new_tensor(HISTORY_NOISE)
    noise = scale * torch.randn_like(history)
    noise[:, -1, :2] = 0.0  # the agent is at the origin of its own frame, heading along x
    noise[:, -1, 6] = 0.0
    observed = torch.arange(frames, device=history.device) >= features["first"][:, None]
    jittered["history"] = history + noise * observed[..., None]
    turn = MAX_TURN_RAD * (2 * torch.rand(size, device=history.device) - 1)
    shift = MAX_SHIFT_M * (2 * torch.rand(size, 2, device=history.device) - 1)
    for name, geometry in PATCHES.items():
        if name in features:
            patches = features[name]
            patches[chosen] = moved(patches[chosen], turn, shift, stretch, geometry)
            jittered[name] = patches
    return jittered, future


def scaled(
    features: Features, future: Tensor, chosen: slice, factor: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """Return features, without the maps, and futures of scenes in another size; time runs as before.

    Args:
        features: features of N agents, in their frames; not modified.
        future: [N, T, 2], m.
        chosen: the n agents whose scenes are scaled.
        factor: [n], factors of the scenes' sizes.
    """
    scale = future.new_ones(len(future))
    scale[chosen] = factor
    result = dict(features)
    history = features["history"].clone()
    history[..., :6] *= scale[:, None, None]  # positions, velocities, accelerations; the rest are angles
    result["history"] = history
    result["speed"] = features["speed"] * scale
    if "neighbors" in features:
        neighbors = features["neighbors"].clone()
        neighbors[..., 0:2] *= scale[:, None, None]
        neighbors[..., 4:8] *= scale[:, None, None]
        result["neighbors"] = neighbors
    return result, future * scale[:, None, None]


def moved(patches: Tensor, turn: Tensor, shift: Tensor, stretch: Tensor, geometry: PatchGeometry) -> Tensor:
    """Return map patches for scenes of another size and slightly different agent poses.

    Pixels that the given patches do not reach are unknown.

    Args:
        patches: [n, 3, S, S].
        turn: [n] rad, change of the heading.
        shift: [n, 2] m, ahead and to the left.
        stretch: [n], factors of the scenes' sizes.
        geometry: geometry of the patches.
    """
    size = geometry.size
    index = torch.arange(size, device=patches.device, dtype=patches.dtype)
    row, column = index - geometry.rows_behind, index - geometry.columns_right
    # In the coordinates of grid_sample, which has the column first
    unit = 2 / size
    cos, sin = (unit * part / stretch for part in (turn.cos(), turn.sin()))
    agent = shift.new_tensor([geometry.columns_right, geometry.rows_behind])
    start = unit * (geometry.pixels_per_meter * shift.flip(1) + agent + 0.5) - 1
    along = start[..., None] + torch.stack([sin, cos], dim=1)[..., None] * row
    across = torch.stack([cos, -sin], dim=1)[..., None] * column
    grid = (along[..., :, None] + across[..., None, :]).permute(0, 2, 3, 1)
    return F.grid_sample(patches, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


def drop_context(features: Features) -> Features:
    """Return features in which some agents lack a map, a part of it, or their neighbours.

    Args:
        features: features in the agents' frames (``model.features.agent_features``), maps packed
            (``Batches``); not modified.
    """
    dropped = dict(features)
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
        dropped[name] = patches
    if "neighbors" in features:
        alone = torch.rand(count, device=device) < NO_NEIGHBORS
        dropped["neighbors"] = features["neighbors"] * ~alone[:, None, None]
    return dropped


def drop_dividers(features: Features) -> Features:
    """Return features in which some agents' maps lack a layer of dividers.

    Args:
        features: as for ``drop_context``.
    """
    dropped = dict(features)
    for name in PATCHES.keys() & features.keys():
        patches = features[name].clone()
        for layer in (1, 2):
            rows = (torch.rand(len(patches), device=patches.device) < NO_DIVIDERS).nonzero()[:, 0]
            patches[rows] = without_layer(patches[rows], layer)
        dropped[name] = patches
    return dropped


def keep_standing(
    future: Tensor, leaving: Tensor, leaving_share: float, generator: torch.Generator
) -> Tensor:
    """Return futures in which most of the agents that stood and leave stay where they are.

    An agent that stood for as long as it was seen had mostly stood before: an earlier pair of it, with the
    same history, ends where it began. The challenge left that pair out.

    Args:
        future: [N, T, 2], m, relative to now.
        leaving: [N] bool, agents that stood and leave.
        leaving_share: share of those that still leave.
        generator: random generator, on the CPU.
    """
    held = leaving & (torch.rand(len(leaving), generator=generator) >= leaving_share)
    return future.masked_fill(held.to(future.device)[:, None, None], 0.0)


def insert_stopped_vehicles(features: Features, future: Tensor) -> Features:
    """Return features in which some agents have one more neighbour: a stopped vehicle beyond where they went.

    Args:
        features: features in the agents' frames, with neighbours; not modified.
        future: [N, T, 2], m, in the agents' frames, relative to now.
    """
    neighbors = features["neighbors"].clone()
    count, places = neighbors.shape[:2]
    end, last_move = future[:, -1], future[:, -1] - future[:, -3]
    # An agent that hardly moves at the end still faces the way it faces now
    direction = torch.where(
        (last_move.norm(dim=-1) > 1.0)[:, None], last_move, last_move.new_tensor([1.0, 0.0])
    )
    direction = direction / direction.norm(dim=-1, keepdim=True)
    across = torch.stack([-direction[:, 1], direction[:, 0]], dim=-1)
    gap = GAP_M[0] + (GAP_M[1] - GAP_M[0]) * torch.rand(count, 1, device=end.device)
    place = end + gap * direction + LATERAL_OFFSET_M * torch.randn(count, 1, device=end.device) * across
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
