"""What shape of network a checkpoint holds."""

from enum import StrEnum
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from model.scene import AgentType
from model.standardization import STATE_SIZE

HIDDEN = 32
"""Width of every encoder (Trajectron++, appendix)."""
DECODER_HIDDEN = 128
"""Width of the decoder's GRU."""


class BlindContext(StrEnum):
    """How the network forecasts from an agent's own history alone."""

    NONE = "none"
    """It cannot (Trajectron++, HalentNet)."""
    NULL = "null"
    """The same network, on a null context (CAB, section 3)."""
    OWN = "own"
    """A second latent and decoder on the history encoding (released Reweight and RUBiZ)."""


class NetworkConfig(BaseModel):
    """One network for each agent type; they share no parameters."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["cvae"] = "cvae"
    agent_types: tuple[AgentType, ...] = (AgentType.VEHICLE,)
    """Types that are forecast."""
    neighbor_types: tuple[AgentType, ...] = (AgentType.VEHICLE, AgentType.PEDESTRIAN)
    """Types that are looked at; empty: no neighbours."""
    uses_map: bool = True
    """Whether vehicles look at the map; pedestrians never do (Trajectron++ for nuScenes)."""
    modes: int = Field(default=25, ge=1, le=255)
    """K, categories of the latent variable."""
    blind: BlindContext = BlindContext.NONE

    @model_validator(mode="after")
    def _types_have_states(self) -> "NetworkConfig":
        for kind in (*self.agent_types, *self.neighbor_types):
            if kind not in STATE_SIZE:
                raise ValueError(f"no network has a state for agents of type {kind.value}")
        return self

    def looks_at_map(self, agent_type: AgentType) -> bool:
        """Whether the network of that type has a map encoder."""
        return self.uses_map and agent_type is AgentType.VEHICLE

    def encoding_size(self, agent_type: AgentType) -> int:
        """Length of the context encoding x."""
        parts = 1 + bool(self.neighbor_types) + self.looks_at_map(agent_type)
        return HIDDEN * parts
