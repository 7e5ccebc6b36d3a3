"""Configurations of networks, as checkpoints hold them."""

from enum import StrEnum
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Discriminator, Field, NonNegativeFloat, Tag, model_validator

from model.features.spec import FeatureSpec, Frame
from model.features.standardization import STATE_SIZE
from model.scenes.scene import AgentType

HIDDEN = 32
"""Width of every encoder (Trajectron++, appendix)."""
DECODER_HIDDEN = 128
"""Width of the decoder's GRU."""


class BlindContext(StrEnum):
    """The way a network forecasts from an agent's own history alone."""

    NONE = "none"
    """No blind forecast (Trajectron++, HalentNet)."""
    NULL = "null"
    """Blind forecasts by the same network, with a null context (CAB, section 3)."""
    OWN = "own"
    """A second latent and decoder on the history encoding (released Reweight and RUBiZ); in the agent's frame
    a second network that sees the history alone, so that it takes no capacity from the first."""


class NetworkConfig(BaseModel):
    """A CVAE for each agent type; types share no parameters."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["cvae"] = "cvae"
    agent_types: tuple[AgentType, ...] = (AgentType.VEHICLE,)
    """Types that are forecast."""
    neighbor_types: tuple[AgentType, ...] = (AgentType.VEHICLE, AgentType.PEDESTRIAN)
    """Types of neighbours that are seen; empty: no neighbours."""
    uses_map: bool = True
    """True if vehicles see the map; pedestrians never do (Trajectron++ for nuScenes)."""
    frame: Frame = Frame.GROUND
    """Frame of features and forecasts; checkpoints without this field use the ground frame."""
    far_map: bool = False
    """True if vehicles also see a map patch that reaches as far as 6 s (agent frame only)."""
    min_sigma_m: tuple[NonNegativeFloat, NonNegativeFloat] = (0.1, 0.3)
    """m, minimum standard deviation of a forecast in any direction, at 1 s and at 6 s, linear in between
    (agent frame only)."""
    modes: int = Field(default=25, ge=1, le=255)
    """K, categories of the latent variable."""
    blind: BlindContext = BlindContext.NONE
    max_control_sigma: float | None = Field(default=None, gt=0)
    """Maximum standard deviation of the controls in prediction, rad/s and m/s² (pedestrians: m/s), before
    calibration, which scales it along with them. It does not apply in training: there a mode may become
    kilometres wide and account for outliers, so that the other modes need not. None: no bound, as
    published."""

    @model_validator(mode="after")
    def _types_have_states(self) -> "NetworkConfig":
        for kind in (*self.agent_types, *self.neighbor_types):
            if kind not in STATE_SIZE:
                raise ValueError(f"no network has a state for agents of type {kind.value}")
        return self

    @model_validator(mode="after")
    def _frame_has_a_network(self) -> "NetworkConfig":
        if self.frame is Frame.GROUND:
            if self.far_map:
                raise ValueError("far_map: networks of the ground frame look at the near patch only")
            return self
        if self.agent_types != (AgentType.VEHICLE,):
            raise ValueError("frame: only vehicles are forecast in the agent's frame")
        if self.max_control_sigma is not None:
            raise ValueError("frame: a network of the agent's frame has no max_control_sigma")
        return self

    @property
    def features(self) -> FeatureSpec:
        """The features that the network takes."""
        return FeatureSpec(self.frame, self.neighbor_types, self.uses_map, self.far_map)

    def looks_at_map(self, agent_type: AgentType) -> bool:
        """Return whether the network of that type has a map encoder."""
        return self.features.looks_at_map(agent_type)

    def encoding_size(self, agent_type: AgentType) -> int:
        """Return the length of the context encoding x."""
        parts = 1 + bool(self.neighbor_types) + self.looks_at_map(agent_type)
        return HIDDEN * parts

    @property
    def supports_blind(self) -> bool:
        """True if the network can forecast from an agent's own history alone."""
        return self.blind is not BlindContext.NONE


class CoverNetConfig(BaseModel):
    """A classifier over a fixed set of trajectories (Phan-Minh et al. 2020), for vehicles."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["covernet"] = "covernet"
    agent_types: tuple[Literal[AgentType.VEHICLE]] = (AgentType.VEHICLE,)
    neighbor_types: tuple[AgentType, ...] = (AgentType.VEHICLE, AgentType.PEDESTRIAN)
    """Types that are drawn into the picture around the agent; empty: none."""
    uses_map: bool = True
    frame: Frame = Frame.GROUND
    """Frame of the features; checkpoints without this field use the ground frame. Pictures and trajectories
    are in the agent's frame either way."""
    far_map: bool = False
    """True if a picture of the far map patch is seen, too (agent frame only)."""
    epsilon: float = Field(default=2.0, gt=0)
    """ε, m: maximum distance of each training trajectory from its nearest member of the set, at any step."""
    steps: int = Field(default=12, ge=1, le=120)
    """T, steps of 0.5 s of the members."""
    members: int = Field(default=0, ge=0, le=100_000)
    """M, size of the trajectory set; 0: unknown, because the set is made when training begins."""
    modes: int = Field(default=25, ge=1, le=255)
    """K, number of members in a forecast: the most likely ones."""

    @model_validator(mode="after")
    def _makes_sense(self) -> "CoverNetConfig":
        if not (self.uses_map or self.neighbor_types):
            raise ValueError("there is nothing in the picture: neither map nor neighbours")
        if self.far_map and self.frame is Frame.GROUND:
            raise ValueError("far_map: networks of the ground frame look at the near patch only")
        if 0 < self.members < self.modes:
            raise ValueError(f"{self.modes} modes cannot be of {self.members} members")
        for kind in self.neighbor_types:
            if kind not in STATE_SIZE:
                raise ValueError(f"agents of type {kind.value} are not drawn")
        return self

    @property
    def features(self) -> FeatureSpec:
        """The features that the network takes."""
        boxes = self.frame is Frame.GROUND
        return FeatureSpec(self.frame, self.neighbor_types, self.uses_map, self.far_map, neighbor_boxes=boxes)

    def looks_at_map(self, agent_type: AgentType) -> bool:
        """Return whether forecasts of agents of that type depend on the map."""
        return self.features.looks_at_map(agent_type)

    @property
    def supports_blind(self) -> bool:
        """True if the network can forecast from an agent's own history alone."""
        return False


def _kind(value: Any) -> str:
    kind = value.get("kind", "cvae") if isinstance(value, dict) else getattr(value, "kind", "")
    return kind if isinstance(kind, str) else ""


AnyNetworkConfig: TypeAlias = Annotated[
    Annotated[NetworkConfig, Tag("cvae")] | Annotated[CoverNetConfig, Tag("covernet")],
    Discriminator(
        _kind, custom_error_type="network_kind", custom_error_message="kind must be cvae or covernet"
    ),
]
"""The configuration of any network. ``kind`` distinguishes them; configurations without it are of a CVAE."""
