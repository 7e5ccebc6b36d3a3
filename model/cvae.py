"""The forecaster around the CVAE networks."""

from collections.abc import Mapping

from torch import Tensor

from model.forecaster import ModelInfo
from model.network_forecaster import NetworkForecaster, Networks
from model.networks.config import NetworkConfig
from model.networks.network import AgentNetwork


class CvaeNetworks(Networks[AgentNetwork]):
    """The networks of a CVAE."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config, {kind: AgentNetwork(config, kind) for kind in config.agent_types})


class CvaeForecaster(NetworkForecaster[CvaeNetworks]):
    """CAB, Trajectron++, Reweight, RUBiZ or HalentNet, depending on the weights.

    Args:
        info: what is known of the model.
        config: the networks' shape.
        tensors: their parameters by name.

    Raises:
        ValueError: the tensors are not those of such networks, naming them.
    """

    def __init__(self, info: ModelInfo, config: NetworkConfig, tensors: Mapping[str, Tensor]) -> None:
        super().__init__(info, lambda: CvaeNetworks(config), tensors)
