"""Forecasters around trained networks: CVAEs and CoverNet."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from model.arrays import Bools, Ints
from model.features.scene_features import network_view, seen_neighbors
from model.features.spec import Frame
from model.forecaster import Context, Features, Forecaster, ModelInfo, Prepared, complete
from model.mixture import TrajectoryMixture
from model.networks.agent_frame import AgentFrameNetwork
from model.networks.config import AnyNetworkConfig, CoverNetConfig, NetworkConfig
from model.networks.covernet import CoverNet
from model.networks.cvae import AgentNetwork
from model.networks.dynamics import Positions
from model.networks.graph import HISTORY_FRAMES, GraphForward
from model.scenes.scene import AgentType, Scene

MIN_VARIANCE = 1e-6
"""m²; the variance of a served forecast is at least that in every direction."""

Network = TypeVar("Network", bound=nn.Module)

Forward = Callable[[Features, Context, int], tuple[Tensor, Positions]]
"""Features, context and steps T → log-weights [N, K] and positions relative to now."""


class Networks(nn.ModuleDict, Generic[Network]):
    """One network per agent type, by the type's name: the parameters of a checkpoint.

    Each takes features, a context and the number of steps T, and returns log-probabilities of its modes
    [N, K] and their ``Positions``, relative to now.

    Args:
        config: configuration of the networks.
        networks: networks by type.
    """

    def __init__(self, config: AnyNetworkConfig, networks: Mapping[AgentType, Network]) -> None:
        super().__init__({kind.value: network for kind, network in networks.items()})
        self.config = config

    def of(self, agent_type: AgentType) -> Network:
        """Return the network of that type."""
        network: Any = self[agent_type.value]
        made: Network = network
        return made


SomeNetworks = TypeVar("SomeNetworks", bound=Networks[Any])


class NetworkForecaster(Forecaster, Generic[SomeNetworks]):
    """A forecaster around networks and their trained parameters.

    Args:
        info: facts about the model.
        make: builder of the networks.
        tensors: parameters of the networks by name.

    Raises:
        ValueError: the tensors are not those of such networks, naming them.
    """

    def __init__(
        self, info: ModelInfo, make: Callable[[], SomeNetworks], tensors: Mapping[str, Tensor]
    ) -> None:
        self.info = info
        with torch.device("meta"):  # skips the initialisation, since the tensors replace all parameters
            self.networks = make()
        self.config = self.networks.config
        self._spec = self.config.features
        _check(dict(self.networks.state_dict()), tensors)
        self.networks.load_state_dict(dict(tensors), assign=True)
        self.networks.eval().requires_grad_(False)
        self._graphs: dict[tuple[AgentType, Context], GraphForward] = {}

    def compile(self, threads: int) -> bool:
        if self.info.history_frames != HISTORY_FRAMES:
            return False
        try:
            self._graphs = {
                (agent_type, context): GraphForward(self.networks.of(agent_type), context, threads)
                for agent_type in self.info.agent_types
                for context in self.info.contexts
            }
        except LookupError:
            return False
        return True

    @property
    def is_compiled(self) -> bool:
        """True if forwards are native calls."""
        return bool(self._graphs)

    def requires_heading(self, agent_type: AgentType) -> bool:
        """Return True for vehicles: a pedestrian's state has no heading, and it sees no map."""
        return agent_type is AgentType.VEHICLE

    def looks_at_map(self, agent_type: AgentType) -> bool:
        """Return whether agents of that type see the map; only vehicles can."""
        return self.config.looks_at_map(agent_type)

    def looks_at_far_map(self, agent_type: AgentType) -> bool:
        """Return whether agents of that type see the far map; only vehicles in the agent's frame can."""
        return self.looks_at_map(agent_type) and self.config.far_map

    def prepare(self, scene: Scene, targets: Ints, context: Context = Context.FULL) -> Features:
        return complete([self.view(scene, targets, context)])

    def view(self, scene: Scene, targets: Ints, context: Context = Context.FULL) -> Prepared:
        agent_type = scene.types[int(targets[0])]
        states = scene.states.last_frames(self.info.history_frames)
        states.require_observed(targets)
        if self.requires_heading(agent_type) and np.isnan(states.heading[targets, -1]).any():
            raise ValueError("an agent to be forecast has no heading")
        return network_view(replace(scene, states=states), targets, agent_type, self._spec, context)

    def sees(self, scene: Scene, targets: Ints) -> Bools:
        states = scene.states.last_frames(self.info.history_frames)
        return seen_neighbors(
            replace(scene, states=states), targets, scene.types[int(targets[0])], self._spec
        )

    @torch.inference_mode()
    def forecast(
        self,
        features: Features,
        agent_type: AgentType,
        context: Context = Context.FULL,
        steps: int | None = None,
    ) -> TrajectoryMixture:
        steps = steps or self.info.steps
        graph = self._graphs.get((agent_type, context))
        if graph is None:
            return network_mixture(self.networks.of(agent_type), features, context, steps, MIN_VARIANCE)
        with one_torch_thread():
            return network_mixture(graph, features, context, steps, MIN_VARIANCE)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Let torch compute in the calling thread alone.

    Its other threads spin for milliseconds after each parallel section, on cores that a graph's own threads
    need: a forward of 32 agents takes twice the CPU time beside them.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def network_mixture(
    network: Forward, features: Features, context: Context, steps: int, min_variance: float | None = None
) -> TrajectoryMixture:
    """Return the forecast of a network as a mixture.

    Args:
        network: one of ``Networks``, or its graph.
        features: the features of N agents.
        context: full or blind.
        steps: T.
        min_variance: m², added to the variances with a millionth of their sum, which is above float32's
            rounding. Then covariances are positive definite; those that come from one control alone have
            rank one. None: covariances stay as the network gives them (training and validation).
    """
    log_weights, positions = network(features, context, steps)
    covariances = positions.covariance
    if min_variance is not None:
        trace = covariances.diagonal(dim1=-2, dim2=-1).sum(-1)
        added = min_variance + 1e-6 * trace
        covariances = covariances + added[..., None, None] * torch.eye(2, dtype=covariances.dtype)
    return TrajectoryMixture(log_weights, positions.mean, covariances, features["origin"])


def _check(expected: Mapping[str, Tensor], given: Mapping[str, Tensor]) -> None:
    faults = [f"{name} is missing" for name in expected if name not in given]
    faults += [f"{name} is not of this network" for name in given if name not in expected]
    for name in expected.keys() & given.keys():
        if expected[name].shape != given[name].shape:
            faults.append(f"{name} is {list(given[name].shape)}, not {list(expected[name].shape)}")
        elif given[name].dtype != torch.float32:
            faults.append(f"{name} is {given[name].dtype}, not float32")
    if faults:
        raise ValueError("; ".join(sorted(faults)[:5]) + (" …" if len(faults) > 5 else ""))


class CvaeNetworks(Networks[AgentNetwork | AgentFrameNetwork]):
    """The networks of a CVAE, one per agent type."""

    def __init__(self, config: NetworkConfig) -> None:
        if config.frame is Frame.AGENT:
            networks: dict[AgentType, AgentNetwork | AgentFrameNetwork] = {
                AgentType.VEHICLE: AgentFrameNetwork(config)
            }
        else:
            networks = {kind: AgentNetwork(config, kind) for kind in config.agent_types}
        super().__init__(config, networks)


class CvaeForecaster(NetworkForecaster[CvaeNetworks]):
    """CAB, Trajectron++, Reweight, RUBiZ or HalentNet, depending on the weights.

    Args:
        info: facts about the model.
        config: configuration of the networks.
        tensors: parameters of the networks by name.

    Raises:
        ValueError: the tensors are not those of such networks, naming them.
    """

    def __init__(self, info: ModelInfo, config: NetworkConfig, tensors: Mapping[str, Tensor]) -> None:
        super().__init__(info, lambda: CvaeNetworks(config), tensors)


class CoverNetworks(Networks[CoverNet]):
    """The networks of CoverNet: a single one, for vehicles."""

    def __init__(self, config: CoverNetConfig) -> None:
        super().__init__(config, {kind: CoverNet(config) for kind in config.agent_types})


class CoverNetForecaster(NetworkForecaster[CoverNetworks]):
    """CoverNet: the most likely members of a fixed set of trajectories.

    Args:
        info: facts about the model.
        config: configuration of the network.
        tensors: parameters and trajectory set of the network by name.

    Raises:
        ValueError: the tensors are not those of such a network, naming them.
    """

    def __init__(self, info: ModelInfo, config: CoverNetConfig, tensors: Mapping[str, Tensor]) -> None:
        super().__init__(info, lambda: CoverNetworks(config), tensors)
