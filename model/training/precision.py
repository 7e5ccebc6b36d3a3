"""In which precision a network's heavy parts are trained."""

from enum import StrEnum

import torch

from model.networks.decoder import ModeDecoder
from model.networks.encoders import MapEncoder


class Precision(StrEnum):
    """Of the convolutions and of the unrolled decoder in training.

    Parameters, latents, the heads' outputs, dynamics and loss are float32 in either, and so is everything
    when the network is evaluated.
    """

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"

    @property
    def dtype(self) -> torch.dtype:
        """As torch calls it."""
        return torch.bfloat16 if self is Precision.BFLOAT16 else torch.float32


def set_precision(networks: torch.nn.Module, precision: Precision) -> None:
    """Sets the precision of every decoder and map encoder."""
    for module in networks.modules():
        if isinstance(module, ModeDecoder | MapEncoder):
            module.training_dtype = precision.dtype
