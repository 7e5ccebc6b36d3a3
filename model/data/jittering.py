"""Augmentation by jitter: what a network should not hang on is moved a little each time it is shown.

Each pair is held with a few noisy reports and the map patches cut for them. Shown for many epochs, a network
learns their very pixels: forecasts then change by metres when a raster is drawn anew or turned. A few hundred
scenes are also learned by heart, futures with them; in another size a scene is another one.
"""

from typing import Final

import torch
import torch.nn.functional as F
from torch import Tensor

from model.forecaster import Features
from model.scenes.raster import FAR, NEAR, PatchGeometry

HISTORY_NOISE: Final = (0.0015, 0.006, 0.007, 0.02, 0.07, 0.07, 0.02, 0.04)
"""Standard deviations, at most, of a history in its scales: 3 cm, 0.1 m/s, 0.2 to 0.35 m/s², 0.01 rad,
0.02 rad/s."""
JITTERED: Final = 0.5
"""Share of the agents whose maps are moved."""
MAX_TURN_RAD: Final = 0.015
"""More would teach that a map does not say where a road is 60 m ahead: 0.05 rad are 3 m there."""
MAX_SHIFT_M: Final = 0.25
MAX_STRETCH: Final = 0.2
"""Scenes are scaled by up to this share, up or down: positions, speeds, accelerations and maps alike."""
NO_DIVIDERS: Final = 0.1
"""Share of the agents whose maps lack a layer of dividers, each of the two: many maps have none."""
_MAPS = {"map": NEAR, "far_map": FAR}


def jitter(features: Features, future: Tensor) -> tuple[Features, Tensor]:
    """Return features and futures of some agents in scenes of another size, their maps turned and shifted a
    little, and of all agents with noise on their histories.

    Args:
        features: in the agents' frames, maps unpacked; maps are overwritten, all else is left as it is.
        future: [N, T, 2], m, in the agents' frames, relative to now; left as it is.
    """
    count = len(future)
    chosen = (torch.rand(count, device=future.device) < JITTERED).nonzero()[:, 0]
    stretch = 1.0 + MAX_STRETCH * (2 * torch.rand(len(chosen), device=future.device) - 1)
    jittered, future = stretched(features, future, chosen, stretch)
    history = jittered["history"]
    frames = history.shape[1]
    scale = torch.rand(count, 1, 1, device=history.device) * history.new_tensor(HISTORY_NOISE)
    noise = scale * torch.randn_like(history)
    noise[:, -1, :2] = 0.0  # the agent is at the origin of its own frame, heading along x
    noise[:, -1, 6] = 0.0
    observed = torch.arange(frames, device=history.device) >= features["first"][:, None]
    jittered["history"] = history + noise * observed[..., None]
    turn = MAX_TURN_RAD * (2 * torch.rand(len(chosen), device=history.device) - 1)
    shift = MAX_SHIFT_M * (2 * torch.rand(len(chosen), 2, device=history.device) - 1)
    bare = torch.rand(count, 2, device=history.device) < NO_DIVIDERS
    for name, geometry in _MAPS.items():
        if name in features:
            patches = features[name]
            patches[chosen] = moved(patches[chosen], turn, shift, stretch, geometry)
            for layer in range(2):
                rows = bare[:, layer].nonzero()[:, 0]
                known = (patches[rows] != 0).any(dim=1)
                patches[rows, layer + 1] = -known.to(patches.dtype)
            jittered[name] = patches
    return jittered, future


def stretched(
    features: Features, future: Tensor, chosen: Tensor, factor: Tensor
) -> tuple[dict[str, Tensor], Tensor]:
    """Return features, but for the maps, and futures of scenes in another size; time runs as before.

    Args:
        features: of N agents, in their frames; left as they are.
        future: [N, T, 2], m.
        chosen: [n] int64, the agents whose scenes are scaled.
        factor: [n], by what.
    """
    scale = future.new_ones(len(future)).index_copy(0, chosen, factor)
    scaled = dict(features)
    history = features["history"].clone()
    history[..., :6] *= scale[:, None, None]  # positions, velocities, accelerations; the rest are angles
    scaled["history"] = history
    scaled["speed"] = features["speed"] * scale
    if "neighbors" in features:
        neighbors = features["neighbors"].clone()
        neighbors[..., 0:2] *= scale[:, None, None]
        neighbors[..., 4:8] *= scale[:, None, None]
        scaled["neighbors"] = neighbors
    return scaled, future * scale[:, None, None]


def moved(patches: Tensor, turn: Tensor, shift: Tensor, stretch: Tensor, geometry: PatchGeometry) -> Tensor:
    """Return patches as they were had the scenes had another size and the agents' poses been a little
    different; what they do not reach is unknown.

    Args:
        patches: [n, 3, S, S].
        turn: [n] rad, of the heading.
        shift: [n, 2] m, ahead and to the left.
        stretch: [n], the factor of the scenes' size.
        geometry: of the patches.
    """
    size = geometry.size
    row = torch.arange(size, device=patches.device, dtype=patches.dtype) - geometry.rows_behind
    column = torch.arange(size, device=patches.device, dtype=patches.dtype) - geometry.columns_right
    cos, sin = (part[:, None, None] / stretch[:, None, None] for part in (turn.cos(), turn.sin()))
    offset = geometry.pixels_per_meter * shift
    ahead = cos * row[:, None] - sin * column[None] + offset[:, :1, None] + geometry.rows_behind
    left = sin * row[:, None] + cos * column[None] + offset[:, 1:, None] + geometry.columns_right
    grid = torch.stack([left, ahead], dim=-1)
    grid = (grid + 0.5) * (2 / size) - 1
    return F.grid_sample(patches, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
