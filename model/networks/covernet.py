"""CoverNet: forecasting as classification over a fixed set of trajectories."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.baselines.uncertainty import oriented_covariance
from model.features.agent_features import NEIGHBOR_POSITION_SCALE
from model.features.neighbor_boxes import BOX_SIZE
from model.features.standardization import HEADING, state_scale
from model.forecaster import Context, Features
from model.networks.config import CoverNetConfig
from model.networks.dynamics import Positions
from model.networks.encoders import ConvShape, MapEncoder
from model.networks.rasterize_boxes import rasterize_boxes
from model.scenes.scene import AgentType

_MAP_CHANNELS = 3
_PIXELS = 64 * 4 * 4
_ENCODING = 64
_OWN = 64
_HIDDEN = 96
_VELOCITY, _ACCELERATION, _RATE = slice(2, 4), slice(4, 6), 7
_SPEED_AHEAD, _ACCELERATION_AHEAD = 2, 4


class CoverNet(nn.Module):
    """The fixed-set classifier of Phan-Minh et al. 2020 (section 3), with a small backbone.

    Inputs are a picture of the scene in the agent's frame (the map patch, and a layer with the other agents
    as boxes at their places now), with ``far_map`` also one of the far map patch, and the agent's speed,
    acceleration along its heading and heading rate. Vehicles and pedestrians share the layer and differ in
    size. So a network that was trained on data without pedestrians sees a pedestrian as a small object
    instead of an input it does not know.

    The logits are over all M members of the trajectory set. A forecast consists of the K most likely
    members, placed at the agent, with the spread of the training trajectories about their nearest members,
    calibrated after training.

    Args:
        config: configuration with ``members`` > 0.

    Raises:
        ValueError: ``members`` is 0.
    """

    cover: Tensor
    """The buffer of ``trajectory_set``, under the name that it has in checkpoints."""
    variance: Tensor
    """[T, 2], m², ahead and to the left: variance of the truth about its nearest member; after calibration,
    variance of a forecast."""

    def __init__(self, config: CoverNetConfig) -> None:
        super().__init__()
        if not config.members:
            raise ValueError("the network's set of trajectories is not known: members is 0")
        self.config = config
        channels = _MAP_CHANNELS * config.uses_map + bool(config.neighbor_types)
        layers: tuple[ConvShape, ...] = ((channels, 16, 5, 2), (16, 32, 5, 2), (32, 48, 3, 2), (48, 64, 3, 2))
        self.picture = MapEncoder(layers, _PIXELS, _ENCODING)
        far: tuple[ConvShape, ...] = ((_MAP_CHANNELS, 16, 5, 2), *layers[1:])
        self.far_picture = MapEncoder(far, _PIXELS, _ENCODING) if config.far_map else None
        self.own = nn.Linear(3, _OWN)
        self.hidden = nn.Linear(_ENCODING * (1 + config.far_map) + _OWN, _HIDDEN)
        self.logits = nn.Linear(_HIDDEN, config.members)
        self.register_buffer("cover", torch.zeros(config.members, config.steps, 2))
        self.register_buffer("variance", torch.ones(config.steps, 2))

    @property
    def trajectory_set(self) -> Tensor:
        """[M, T, 2], m, x ahead and y to the left of the agent now."""
        return self.cover

    def scores(self, features: Features) -> Tensor:
        """Return the logits of all members: [N, M]."""
        layers = [features["map"]] if self.config.uses_map else []
        if self.config.neighbor_types:
            layers.append(rasterize_boxes(boxes(features))[:, None])
        parts = [self.picture(torch.cat(layers, dim=1))]
        if self.far_picture is not None:
            parts.append(self.far_picture(features["far_map"]))
        parts.append(F.relu(self.own(_kinematics(features))))
        hidden = F.relu(self.hidden(torch.cat(parts, dim=1)))
        logits: Tensor = self.logits(hidden)
        return logits

    def forward(self, features: Features, context: Context, steps: int) -> tuple[Tensor, Positions]:
        """Return normalised log-probabilities of the K most likely members [N, K], and their positions.

        Raises:
            ValueError: the context is blind, or there are more steps than the members have.
        """
        if context is not Context.FULL:
            raise ValueError("this network has no blind forecast")
        if steps > self.config.steps:
            raise ValueError(f"this network's trajectories have {self.config.steps} steps, not {steps}")
        logits, likeliest = self.scores(features).topk(self.config.modes, dim=1)
        heading = present_heading(features)
        mean = turned(self.trajectory_set[likeliest, :steps], heading)
        along, across = self.variance[:steps].unbind(dim=1)
        covariance = oriented_covariance(along, across, heading[:, None].expand(-1, steps))
        shared = covariance[:, None].expand(-1, self.config.modes, -1, -1, -1)
        return F.log_softmax(logits, dim=1), Positions(mean, shared)


def present_heading(features: Features) -> Tensor:
    """Return the headings of vehicles now in the ground frame: [N] rad."""
    history = features["history"]
    if "heading" in features:
        return features["heading"].to(history.dtype)
    heading: Tensor = history[:, -1, HEADING] * _SCALE[HEADING]
    return heading


def turned(vectors: Tensor, angle: Tensor) -> Tensor:
    """Rotate vectors [N, …, 2] counter-clockwise by angles [N], rad."""
    shape = (-1, *[1] * (vectors.dim() - 2))
    cos, sin = torch.cos(angle).view(shape), torch.sin(angle).view(shape)
    x, y = vectors.unbind(dim=-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)


def _kinematics(features: Features) -> Tensor:
    """Return speed, acceleration along the heading and heading rate, standardised: [N, 3]."""
    now = features["history"][:, -1]
    if "heading" in features:  # histories of the agent's frame are standardised along the heading
        return torch.stack([now[:, _SPEED_AHEAD], now[:, _ACCELERATION_AHEAD], now[:, _RATE]], dim=1)
    heading = present_heading(features)
    ahead = torch.stack([torch.cos(heading), torch.sin(heading)], dim=1)
    speed = now[:, _VELOCITY].norm(dim=1)
    return torch.stack([speed, (now[:, _ACCELERATION] * ahead).sum(dim=1), now[:, _RATE]], dim=1)


def boxes(features: Features) -> Tensor:
    """Return the neighbours as boxes [N, S, 5] (``model.features.neighbor_boxes``)."""
    if "neighbors" not in features:
        return features["neighbor_boxes"]
    neighbors = features["neighbors"]
    place = NEIGHBOR_POSITION_SCALE * neighbors[..., :2]
    turn = torch.atan2(neighbors[..., 3], neighbors[..., 2])
    kinds = neighbors[..., 8:10] * neighbors[..., 10:]
    sizes = neighbors.new_tensor([BOX_SIZE[AgentType.VEHICLE], BOX_SIZE[AgentType.PEDESTRIAN]])
    return torch.cat([place, turn[..., None], kinds @ sizes], dim=-1)


_SCALE = state_scale(AgentType.VEHICLE, AgentType.VEHICLE).tolist()
