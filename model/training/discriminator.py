"""HalentNet's discriminator: tells real trajectories from generated ones, and which latent made them.

Zhu et al., "HalentNet: Multimodal trajectory forecasting with hallucinative intents", ICLR 2021.
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils.parametrizations import spectral_norm

from model.scenes.raster import COLUMNS_RIGHT, PATCH_PIXELS_PER_METER, PATCH_SIZE, ROWS_BEHIND

BUMP_PIXELS = 5.0
"""Standard deviation of the bump that marks a position."""
BUMP_PEAK = 9.0
CHANNELS = 64
"""Channels of the first layer; the i-th has i times as many."""
LAYERS = 4
_ROWS = 4
"""Rows and columns of the last convolution's output."""


class Verdict(NamedTuple):
    """Output of the discriminator."""

    real: Tensor
    """[N]; 1: real, 0: generated."""
    latent_logits: Tensor
    """[N, K]."""


class Discriminator(nn.Module):
    """Four spectral-normalised convolutions over the map patch and one channel for each future step.

    Args:
        steps: T, steps of the trajectories.
        modes: K, latent categories.
        dtype: precision of the convolutions; parameters and heads are float32.
    """

    def __init__(self, steps: int, modes: int, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        sizes = [3 + steps, *(CHANNELS * (i + 1) for i in range(LAYERS))]
        self.discriminator_convs = nn.ModuleList(
            spectral_norm(nn.Conv2d(sizes[i], sizes[i + 1], 4, stride=2)) for i in range(LAYERS)
        )
        self.real = nn.Linear(sizes[-1] * _ROWS**2, 1)
        self.latent = nn.Linear(sizes[-1] * _ROWS**2, modes)
        self._dtype = dtype
        # On CPUs this makes convolutions of many channels three times as fast
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, patches: Tensor | None, paths: Tensor) -> Verdict:
        """Return the verdict on trajectories.

        Args:
            patches: [N, 3, 100, 100] in [-1, 1]; None: zeros in place of a map.
            paths: [N, T, 2], m, in the agent's frame: ahead, to the left.
        """
        marks = draw(paths, self._dtype)
        if patches is None:
            patches = marks.new_zeros(len(paths), 3, PATCH_SIZE, PATCH_SIZE)
        seen = torch.cat([patches.to(self._dtype), marks], dim=1).contiguous(
            memory_format=torch.channels_last
        )
        low = self._dtype is not torch.float32
        with torch.autocast(seen.device.type, self._dtype, enabled=low):
            for conv in self.discriminator_convs:
                seen = F.leaky_relu(conv(seen), 0.2)
        flat = seen.flatten(1).float()
        return Verdict(self.real(flat)[:, 0], self.latent(flat))


def draw(paths: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return a Gaussian bump at each position, in the patch's frame: [N, T, 100, 100]; differentiable.

    Args:
        paths: [N, T, 2], m, ahead and to the left of the agent.
        dtype: type of the result.
    """
    pixels = torch.arange(PATCH_SIZE, dtype=paths.dtype, device=paths.device)
    place = paths * PATCH_PIXELS_PER_METER
    rows = _bump(pixels - ROWS_BEHIND - place[..., :1])
    columns = _bump(pixels - COLUMNS_RIGHT - place[..., 1:])
    return (BUMP_PEAK * rows).to(dtype)[..., :, None] * columns.to(dtype)[..., None, :]


def _bump(distance: Tensor) -> Tensor:
    return torch.exp(-0.5 * (distance / BUMP_PIXELS).square())
