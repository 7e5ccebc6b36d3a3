"""The forecaster around CoverNet."""

from collections.abc import Mapping

from torch import Tensor

from model.forecaster import ModelInfo
from model.networks.forecaster import NetworkForecaster, Networks
from model.networks.config import CoverNetConfig
from model.networks.covernet import CoverNet


class CoverNetworks(Networks[CoverNet]):
    """The networks of CoverNet: one, for vehicles."""

    def __init__(self, config: CoverNetConfig) -> None:
        super().__init__(config, {kind: CoverNet(config) for kind in config.agent_types})


class CoverNetForecaster(NetworkForecaster[CoverNetworks]):
    """CoverNet: the likeliest members of a fixed set of trajectories.

    Args:
        info: what is known of the model.
        config: the network's shape.
        tensors: its parameters and its set of trajectories by name.

    Raises:
        ValueError: the tensors are not those of such a network, naming them.
    """

    def __init__(self, info: ModelInfo, config: CoverNetConfig, tensors: Mapping[str, Tensor]) -> None:
        super().__init__(info, lambda: CoverNetworks(config), tensors)
