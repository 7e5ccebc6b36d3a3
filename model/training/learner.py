"""What a training step changes: networks and their optimisers, whichever the method."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from model.data.hiding import hide_context
from model.data.holdups import block
from model.data.jittering import jitter
from model.data.packing import unpack_patches
from model.forecaster import Features
from model.networks.agent_frame import AgentFrameNetwork
from model.networks.config import NetworkConfig
from model.networks.covernet import turned
from model.networks.forecaster import CvaeNetworks, Networks
from model.networks.network import AgentNetwork
from model.scenes.scene import AgentType
from model.training.config import Method, TrainingConfig
from model.training.dropout import scale_dropout
from model.training.mixture_objective import mixture_objective
from model.training.objectives import OBJECTIVES, Loss, Weights
from model.training.precision import set_precision
from model.training.processes import average_gradients


class Batch(NamedTuple):
    """Pairs, ready for a network."""

    features: Features
    future: Tensor
    """[N, T, 2], m, relative to now."""


class Learner(ABC):
    """Networks that learn.

    ``networks`` are those that forecast: they are judged and shipped. A method may have others, which
    matter to the training only.
    """

    def __init__(self, networks: Networks[Any]) -> None:
        self.networks = networks

    @property
    @abstractmethod
    def batch_sizes(self) -> tuple[int, ...]:
        """Pairs in each of the batches that a step takes."""

    @property
    def others(self) -> Mapping[str, nn.Module]:
        """Networks of the training only, by name."""
        return {}

    @property
    @abstractmethod
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        """By name; each of parameters of ``networks`` or ``others``."""

    @abstractmethod
    def step(self, batches: Sequence[Batch], weights: Weights, rate: float) -> dict[str, Tensor]:
        """One step.

        Args:
            batches: of ``batch_sizes``, or of a process's share of them.
            weights: of the losses' terms at this step.
            rate: the learning rate.

        Returns:
            The loss and its terms, detached.
        """

    def modules(self) -> dict[str, nn.Module]:
        """All networks by name."""
        return {"network": self.networks, **self.others}


class DescentLearner(Learner):
    """Networks with one optimiser of all their parameters.

    Args:
        config: of the run.
        networks: that learn, on their device.
    """

    def __init__(self, config: TrainingConfig, networks: Networks[Any]) -> None:
        super().__init__(networks)
        set_precision(networks, config.precision)
        scale_dropout(networks, config.dropout_factor)
        self.optimizer = torch.optim.AdamW(
            self._groups(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self._clip = config.gradient_clip
        self._batch_size = config.batch_size

    @property
    def batch_sizes(self) -> tuple[int, ...]:
        return (self._batch_size,)

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        return {"optimizer": self.optimizer}

    def descend(self, loss: Tensor, rate: float) -> None:
        """A step of the optimiser against a loss."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group.get("rate_factor", 1.0)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        average_gradients(self.networks.parameters())
        torch.nn.utils.clip_grad_norm_(self.networks.parameters(), self._clip)
        self.optimizer.step()

    def _groups(self) -> list[dict[str, object]]:
        """Parameters for the optimiser; ``rate_factor`` of a group multiplies its learning rate."""
        return [{"params": list(self.networks.parameters())}]


class CvaeLearner(DescentLearner):
    """A CVAE under one of the objectives.

    Args:
        config: of the run.
        device: of the networks.
    """

    def __init__(self, config: TrainingConfig, device: torch.device) -> None:
        assert isinstance(config.network, NetworkConfig)  # noqa: S101 (for the type checker; the method's)
        networks = CvaeNetworks(config.network).to(device)
        super().__init__(config, networks)
        network = networks.of(AgentType.VEHICLE)
        assert isinstance(network, AgentNetwork)  # noqa: S101 (likewise)
        self.network = network
        self._objective = OBJECTIVES[config.method.value]

    def step(self, batches: Sequence[Batch], weights: Weights, rate: float) -> dict[str, Tensor]:
        (batch,) = batches
        loss = self._objective(self.network, batch.features, batch.future, weights)
        self.descend(loss.value, rate)
        return logged(loss)


class AgentFrameLearner(DescentLearner):
    """A network of the agent's frame under the mixture's objective.

    Args:
        config: of the run.
        device: of the networks.
    """

    def __init__(self, config: TrainingConfig, device: torch.device) -> None:
        assert isinstance(config.network, NetworkConfig)  # noqa: S101 (for the type checker; the method's)
        networks = CvaeNetworks(config.network).to(device)
        super().__init__(config, networks)
        network = networks.of(AgentType.VEHICLE)
        assert isinstance(network, AgentFrameNetwork)  # noqa: S101 (likewise)
        self.network = network
        self._weights = config.mixture
        self._contrast = config.method is Method.CAB
        self._hide = config.hide
        self._block = config.block
        self._jitter = config.jitter

    def step(self, batches: Sequence[Batch], weights: Weights, rate: float) -> dict[str, Tensor]:
        (batch,) = batches
        future = turned(batch.future, -batch.features["heading"].to(batch.future.dtype))
        features = block(batch.features, future) if self._block else batch.features
        features = dict(hide_context(features) if self._hide else features)
        for name in features.keys() & {"map", "far_map"}:
            features[name] = unpack_patches(features[name])
        if self._jitter:
            features, future = jitter(features, future)
        loss = mixture_objective(self.network, features, future, self._weights, self._contrast)
        self.descend(loss.value, rate)
        return logged(loss)


def logged(loss: Loss) -> dict[str, Tensor]:
    """A loss and its terms for the log."""
    return {"loss": loss.value.detach()} | {name: term.detach() for name, term in loss.terms.items()}
