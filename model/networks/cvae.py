"""The forecaster around the CVAE networks."""

from collections.abc import Mapping

from torch import Tensor

from model.forecaster import ModelInfo
from model.networks.forecaster import NetworkForecaster, Networks
from model.networks.agent_frame import AgentFrameNetwork
from model.networks.config import Frame, NetworkConfig
from model.networks.network import AgentNetwork
from model.scenes.scene import AgentType


class CvaeNetworks(Networks[AgentNetwork | AgentFrameNetwork]):
    """The networks of a CVAE."""

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
        info: what is known of the model.
        config: the networks' shape.
        tensors: their parameters by name.

    Raises:
        ValueError: the tensors are not those of such networks, naming them.
    """

    def __init__(self, info: ModelInfo, config: NetworkConfig, tensors: Mapping[str, Tensor]) -> None:
        super().__init__(info, lambda: CvaeNetworks(config), tensors)
