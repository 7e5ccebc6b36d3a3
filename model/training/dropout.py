"""How much of what passes through a network is left out in training (Srivastava et al. 2014)."""

from torch import nn


def scale_dropout(networks: nn.Module, factor: float) -> None:
    """Multiplies the rate of every dropout layer; 0 turns it off.

    The published rates (0.25 of the recurrent encodings, 0.5 of the map's) are for networks that would learn
    their training set by heart.
    """
    for module in networks.modules():
        if isinstance(module, nn.Dropout):
            module.p *= factor
