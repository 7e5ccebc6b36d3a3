"""Pairs made up for training tests."""

import torch
from torch import Tensor

from loadtest.forward import features
from model.features.neighbor_boxes import BOX_NUMBERS, BOXES
from model.forecaster import Features
from model.networks.config import AnyNetworkConfig, BlindContext, CoverNetConfig, NetworkConfig
from model.networks.covernet import present_heading, turned
from model.training.config import Method, TrainingConfig


class MadeUpPairs:
    """Vehicles that go on at their velocity; the network can learn that."""

    def __init__(self, pairs: int) -> None:
        self._features = features(pairs)
        self._features["neighbor_boxes"] = torch.zeros(pairs, BOXES, BOX_NUMBERS)
        ahead = 0.5 * torch.arange(1, 13)
        self._future = self._features["velocity"][:, None, :] * ahead[:, None]
        self._turned = torch.linspace(0, 1, pairs)

    def __len__(self) -> int:
        return len(self._future)

    @property
    def turned(self) -> Tensor:
        """[P], a third of them curved."""
        return self._turned

    @property
    def leaving(self) -> Tensor:
        """[P], none."""
        return torch.zeros(len(self), dtype=torch.bool)

    @property
    def paths(self) -> Tensor:
        """[P, 12, 2], the futures in the agents' own frames."""
        return turned(self._future, -present_heading(self._features))

    def batch(self, indices: Tensor, turns: Tensor | None = None) -> tuple[Features, Tensor]:
        """Return pairs as a BatchSource does; turning is left out."""
        return {name: t[indices] for name, t in self._features.items()}, self._future[indices]


def small_config(method: Method = Method.CAB, epochs: int = 2, **changes: object) -> TrainingConfig:
    """Return settings of a run of seconds."""
    blind = {Method.CAB: BlindContext.NULL, Method.TRAJECTRON: BlindContext.NONE}.get(
        method, BlindContext.OWN
    )
    network: AnyNetworkConfig = NetworkConfig(blind=blind, modes=5)
    if method is Method.COVERNET:
        network = CoverNetConfig(modes=5)
    values: dict[str, object] = {
        "method": method,
        "description": "A test.",
        "network": network,
        "learning_rate": 0.003,
        "epochs": epochs,
        "batch_size": 16,
        "adversarial_batch_size": 2,
    }
    return TrainingConfig.model_validate(values | changes)
