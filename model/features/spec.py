"""The specification of a network's features: in which frame they are, and what of a scene they show.

Every network's configuration (``model.networks.config``) states it as ``features``. It is defined below the
networks, so that making features needs no network.
"""

from dataclasses import dataclass
from enum import StrEnum

from model.scenes.scene import AgentType


class Frame(StrEnum):
    """The frame that a network sees and forecasts in."""

    GROUND = "ground"
    """The client's ground frame, moved to the agent (published Trajectron++)."""
    AGENT = "agent"
    """The agent's own: moved to it and turned by its heading (``model.networks.agent_frame``)."""


@dataclass(frozen=True)
class FeatureSpec:
    """The features that ``model.features.scene_features.network_features`` makes of a scene."""

    frame: Frame
    neighbor_types: tuple[AgentType, ...]
    """Types of neighbours that are seen; empty: no neighbours."""
    uses_map: bool
    """True if vehicles see the near map patch; pedestrians never do (Trajectron++ for nuScenes)."""
    far_map: bool = False
    """True if vehicles also see the far map patch (agent frame only)."""
    neighbor_boxes: bool = False
    """True if neighbours are boxes (``model.features.neighbor_boxes``) instead of summed histories (ground
    frame only)."""

    def looks_at_map(self, agent_type: AgentType) -> bool:
        """Return whether agents of that type see the map."""
        return self.uses_map and agent_type is AgentType.VEHICLE
