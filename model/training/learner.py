"""Learners: networks, their optimisers, and what one training step does to them."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from model.data.packing import unpack_patches
from model.data.perturbation import drop_context, drop_dividers, insert_stopped_vehicles, jitter
from model.forecaster import Features
from model.networks.agent_frame import AgentFrameNetwork
from model.networks.agent_frame import MapEncoder as PatchEncoder
from model.networks.config import NetworkConfig
from model.networks.covernet import turned
from model.networks.cvae import AgentNetwork
from model.networks.decoder import ModeDecoder
from model.networks.encoders import MapEncoder
from model.networks.forecaster import CvaeNetworks, Networks
from model.scenes.scene import AgentType
from model.training.config import TrainingConfig
from model.training.mixture_objective import mixture_objective
from model.training.objectives import OBJECTIVES, Loss, LossWeights
from model.training.processes import average_gradients


class Batch(NamedTuple):
    """Pairs as a network takes them."""

    features: Features
    future: Tensor
    """[N, T, 2], m, relative to now."""


class Learner(ABC):
    """Networks in training.

    ``networks`` are those that forecast, which are evaluated and shipped; ``others`` are used
    in training only.
    """

    def __init__(self, networks: Networks[Any]) -> None:
        self.networks = networks

    @property
    @abstractmethod
    def batch_sizes(self) -> tuple[int, ...]:
        """Pairs in each of the batches that a step takes."""

    @property
    def others(self) -> Mapping[str, nn.Module]:
        """Networks used in training only, by name."""
        return {}

    @property
    @abstractmethod
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Optimisers by name; each has parameters of ``networks`` or ``others``."""

    @abstractmethod
    def step(self, batches: Sequence[Batch], weights: LossWeights, rate: float) -> dict[str, Tensor]:
        """Do one training step.

        Args:
            batches: batches of ``batch_sizes``, or of this process's share of them.
            weights: weights of the losses' terms at this step.
            rate: the learning rate.

        Returns:
            The loss and its terms, detached.
        """

    def modules(self) -> dict[str, nn.Module]:
        """Return all networks by name."""
        return {"network": self.networks, **self.others}


class DescentLearner(Learner):
    """Networks with one optimiser (AdamW) for all their parameters.

    Args:
        config: settings of the run.
        networks: the networks, on their device.
        map_rate_factor: factor on the learning rate of the map encoders.
    """

    def __init__(self, config: TrainingConfig, networks: Networks[Any], map_rate_factor: float = 1.0) -> None:
        super().__init__(networks)
        set_precision(networks, config.precision.dtype_on(next(networks.parameters()).device))
        scale_dropout(networks, config.dropout_factor)
        self.optimizer = torch.optim.AdamW(
            _groups(networks, map_rate_factor), lr=config.learning_rate, weight_decay=config.weight_decay
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
        """Do one optimiser step on a loss."""
        set_rate(self.optimizer, rate)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        average_gradients(self.networks.parameters())
        torch.nn.utils.clip_grad_norm_(self.networks.parameters(), self._clip)
        self.optimizer.step()


class CvaeLearner(DescentLearner):
    """A CVAE under its method's objective (``model.training.objectives``).

    Args:
        config: settings of the run.
        device: device of the networks.
        map_rate_factor: factor on the learning rate of the map encoder.
    """

    def __init__(self, config: TrainingConfig, device: torch.device, map_rate_factor: float = 1.0) -> None:
        assert isinstance(config.network, NetworkConfig)  # noqa: S101 (for the type checker; the method's)
        networks = CvaeNetworks(config.network).to(device)
        super().__init__(config, networks, map_rate_factor)
        network = networks.of(AgentType.VEHICLE)
        assert isinstance(network, AgentNetwork)  # noqa: S101 (likewise)
        self.network = network
        self._objective = OBJECTIVES[config.method.value]

    def step(self, batches: Sequence[Batch], weights: LossWeights, rate: float) -> dict[str, Tensor]:
        (batch,) = batches
        loss = self._objective(self.network, batch.features, batch.future, weights)
        self.descend(loss.value, rate)
        return logged(loss)


class AgentFrameLearner(DescentLearner):
    """A network of the agent's frame under the mixture objective (``model.training.mixture_objective``).

    Args:
        config: settings of the run.
        device: device of the networks.
    """

    def __init__(self, config: TrainingConfig, device: torch.device) -> None:
        assert isinstance(config.network, NetworkConfig)  # noqa: S101 (for the type checker; the method's)
        networks = CvaeNetworks(config.network).to(device)
        super().__init__(config, networks)
        network = networks.of(AgentType.VEHICLE)
        assert isinstance(network, AgentFrameNetwork)  # noqa: S101 (likewise)
        self.network = network
        self._config = config

    def step(self, batches: Sequence[Batch], weights: LossWeights, rate: float) -> dict[str, Tensor]:
        (batch,) = batches
        features, future = perturbed(batch, self._config)
        loss = mixture_objective(self.network, features, future, self._config.mixture, self._config.method)
        self.descend(loss.value, rate)
        return logged(loss)


def perturbed(batch: Batch, config: TrainingConfig) -> Batch:
    """Return a batch of the agent's frame as a network is shown it.

    Args:
        batch: features in the agents' frames, maps packed, and the future in the ground frame.
        config: settings that name the perturbations.

    Returns:
        Features, perturbed, with maps unpacked, and the future in the agents' frames.
    """
    future = turned(batch.future, -batch.features["heading"].to(batch.future.dtype))
    features = batch.features
    if config.stopped_vehicles:
        features = insert_stopped_vehicles(features, future)
    features = drop_context(features) if config.context_dropout else features
    features = dict(drop_dividers(features) if config.jitter else features)
    for name in features.keys() & {"map", "far_map"}:
        features[name] = unpack_patches(features[name])
    return Batch(*(jitter(features, future) if config.jitter else (features, future)))


def set_rate(optimizer: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of all parameter groups; ``rate_factor`` multiplies that of a group."""
    for group in optimizer.param_groups:
        group["lr"] = rate * group.get("rate_factor", 1.0)


def _groups(networks: nn.Module, map_rate_factor: float) -> list[dict[str, object]]:
    """Return the optimiser's parameter groups; ``rate_factor`` multiplies a group's learning rate."""
    named = list(networks.named_parameters())
    of_map = [parameter for name, parameter in named if ".map_encoder." in name]
    if map_rate_factor == 1.0 or not of_map:
        return [{"params": [parameter for _, parameter in named]}]
    others = [parameter for name, parameter in named if ".map_encoder." not in name]
    return [{"params": others}, {"params": of_map, "rate_factor": map_rate_factor}]


def logged(loss: Loss) -> dict[str, Tensor]:
    """Return a loss and its terms for the log."""
    return {"loss": loss.value.detach()} | {name: term.detach() for name, term in loss.terms.items()}


def set_precision(networks: nn.Module, dtype: torch.dtype) -> None:
    """Set the training precision of every decoder and map encoder."""
    for module in networks.modules():
        if isinstance(module, ModeDecoder | MapEncoder | PatchEncoder):
            module.training_dtype = dtype


def scale_dropout(networks: nn.Module, factor: float) -> None:
    """Multiply the rate of every dropout layer (Srivastava et al. 2014); 0 turns dropout off.

    The published rates (0.25 on the recurrent encodings, 0.5 on the map's) suit networks that would otherwise
    overfit their training set.
    """
    for module in networks.modules():
        if isinstance(module, nn.Dropout):
            module.p *= factor
