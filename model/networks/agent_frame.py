"""The network of the agent's own frame: origin at the agent, x along its heading.

It has the structure of Trajectron++ (Salzmann et al. 2020, section 4): encoders of history, neighbours and
map, a categorical latent z, and a decoder that forecasts controls of a unicycle for each category. It differs
where experiments favoured it (figures in ``docs/experiments.md``):

- Everything is in the agent's frame, so a scene turned or shifted is forecast turned or shifted.
- There are two map patches: a near, fine one, and a far one that reaches as far as 6 s.
- All steps of a mode are decoded at once instead of by an unrolled GRU: first as a proposal, then again with
  the map and the neighbours along the proposal (propose and refine, as in QCNet, Zhou et al. 2023).
- Standard deviations of positions along and across the path are outputs, not propagated from the controls.
- p(z | x) is trained as the weights of the mixture itself, without a q(z | x, y).

``AgentFrameNetwork`` comes first; below it stand its parts, in the order in which a forward pass meets them.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.features.agent_features import (
    NEIGHBOR_FEATURES,
    NEIGHBOR_POSITION_SCALE,
    NEIGHBOR_VELOCITY_SCALE,
)
from model.features.standardization import STATE_SIZE
from model.forecaster import Context, Features
from model.networks.config import BlindContext, NetworkConfig
from model.networks.dynamics import Positions
from model.networks.recurrent import HistoryLSTM
from model.scenes.raster import FAR, PatchGeometry
from model.scenes.scene import STEP_SECONDS, AgentType

STEPS = 12
"""T, number of decoded steps of 0.5 s."""
_SECONDS = tuple(STEP_SECONDS * step for step in range(1, STEPS + 1))
_USUAL_LOG_SIGMA = tuple((math.log(0.15 * s**1.5), math.log(0.08 * s**1.3)) for s in _SECONDS)
"""[T, 2], logarithms of standard deviations (m) along and across a path; the decoder adds to them."""
_WIDTH = 64
"""Width of every encoding."""
_HIDDEN = 128
"""Width of a mode's hidden state."""
_DROPOUT = 0.1
"""Dropout of the maps' encodings and of the joint encoding."""
_NEAR_M = (20.0, 4.0)
"""m ahead and to the left; within it a neighbour's position has a fine encoding."""
_STEP_WIDTH = 32
"""Width of the encoding read at one step of a mode."""
_CONTROL_SCALE = (0.3, 2.0)
"""rad/s and m/s², units of the decoder's controls."""
_MAX_HEADING_CORRECTION = 0.3
"""rad, maximum correction of the initial heading, since given headings are noisy."""
_MAX_SPEED_CORRECTION = 2.0
"""m/s, maximum correction of the initial speed, likewise."""
_DRIVES_AHEAD = 1.0
"""m/s; a faster agent does not reverse within the 6 s that are decoded."""
_READ_LATERAL_M = (-6.0, -3.5, -1.75, 0.0, 1.75, 3.5, 6.0)
_READ_AHEAD_M = (0.0, 5.0)
"""m, points around each position of a mode at which the map is read, in the frame of the path there."""
_READ_EVERY = 2
"""Number of steps from one at which map and neighbours are read to the next."""
_NARROW_M, _WIDE_M = 1.2, 3.0
"""m, scales of the distance across a path within which a neighbour is on it, narrowly and widely."""
_HALF_LENGTH_M = 3.0
"""m, extent of a neighbour ahead and behind, the agent's own length included."""
_GAP_M = 12.0
"""m, scale on which the influence of a neighbour ahead decays."""


class Path(NamedTuple):
    """Means of the modes in the agent's frame: [N, K, T] each."""

    x: Tensor
    """m, ahead."""
    y: Tensor
    """m, to the left."""
    heading: Tensor
    """rad, of the path at the step."""
    speed: Tensor
    """m/s, signed along the heading."""


class Modes(NamedTuple):
    """The output of the network in the agent's frame."""

    logits: Tensor
    """[N, K], logits of p(z | x)."""
    proposal: Path
    path: Path
    sigma: Tensor
    """[N, K, T, 2], m, along and across the path."""
    controls: Tensor
    """[N, K, T, 2], heading rate (rad/s) and acceleration (m/s²) of the path."""
    start: Tensor
    """[N, K, 2], heading (rad) and speed (m/s) at which the path begins."""


class AgentFrameNetwork(nn.Module):
    """The network of vehicles in their own frame, with a full and a blind context.

    A blind forecast is the same network with a null context (CAB, Ben-Younes et al. 2022, section 3): an
    unknown map and no neighbours, as in a request without map and neighbours. With ``blind = "own"`` it is
    that of ``blind_network``, which sees the history alone.
    """

    width: Tensor
    """[T], factor on the standard deviations, fitted after training."""
    temperature: Tensor
    """[], divisor of the logits, fitted after training."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.history_encoder = HistoryLSTM(STATE_SIZE[AgentType.VEHICLE], _WIDTH)
        self.neighbor_encoder = NeighborEncoder() if config.neighbor_types else None
        self.map_encoder = MapEncoder(_DROPOUT) if config.uses_map else None
        self.far_map_encoder = MapEncoder(_DROPOUT) if config.far_map else None
        self.dropout = nn.Dropout(_DROPOUT)
        parts = 1 + sum(
            part is not None for part in (self.neighbor_encoder, self.map_encoder, self.far_map_encoder)
        )
        self.context = nn.Linear(parts * _WIDTH, _HIDDEN)
        self.modes = nn.Parameter(torch.randn(config.modes, _HIDDEN))
        self.propose_hidden = nn.Linear(_HIDDEN, _HIDDEN)
        self.propose = nn.Linear(_HIDDEN, 2 * STEPS + 2)
        self.read_state = nn.Linear(4, _STEP_WIDTH)
        points = len(_READ_LATERAL_M) * len(_READ_AHEAD_M)
        self.read_map = (
            nn.ModuleList([nn.Linear(points, _STEP_WIDTH, bias=False) for _ in range(3)])
            if config.far_map
            else None
        )
        self.read_neighbors = nn.Linear(3, _STEP_WIDTH, bias=False) if config.neighbor_types else None
        self.refine_hidden = nn.Linear(_HIDDEN + STEPS // _READ_EVERY * _STEP_WIDTH, _HIDDEN)
        self.refine = nn.Linear(_HIDDEN, 2 * STEPS)
        self.sigma = nn.Linear(_HIDDEN, 2 * STEPS)
        self.logits = nn.Linear(_HIDDEN, 1)
        self.mode_logits = nn.Linear(_HIDDEN, config.modes)
        for head in (self.refine, self.sigma, self.logits, self.mode_logits):
            nn.init.zeros_(head.bias)
            with torch.no_grad():
                head.weight.mul_(0.1)
        self.register_buffer("width", torch.ones(STEPS))
        self.register_buffer("temperature", torch.ones(()))
        alone = {"neighbor_types": (), "uses_map": False, "far_map": False, "blind": BlindContext.NONE}
        self.blind_network = (
            AgentFrameNetwork(config.model_copy(update=alone)) if config.blind is BlindContext.OWN else None
        )

    def branch(self, context: Context) -> "tuple[AgentFrameNetwork, Context]":
        """Return the network that forecasts in a context, and the context that it is given."""
        if context is Context.BLIND and self.blind_network is not None:
            return self.blind_network, Context.FULL
        return self, context

    @property
    def variance_floor(self) -> Tensor:
        """[T], m², added to the variances of a forecast, so that it bounds them in any direction."""
        first, last = self.config.min_sigma_m
        return self.width.new_tensor([(first + (last - first) * (s - 1) / 5) ** 2 for s in _SECONDS])

    def encode(self, features: Features, context: Context) -> Tensor:
        """Return the encoding of the features: [N, 128]."""
        own = self.history_encoder(features["history"], features["first"])
        parts = [own]
        full = context is Context.FULL
        if self.neighbor_encoder is not None:
            neighbors, present = _neighbors(features, full)
            parts.append(self.neighbor_encoder(neighbors, present, own))
        for encoder, name in ((self.map_encoder, "map"), (self.far_map_encoder, "far_map")):
            if encoder is not None and full:
                parts.append(encoder(features[name]))
            elif encoder is not None:
                parts.append(encoder(own.new_zeros(1, 3, 100, 100)).expand(own.shape[0], -1))
        encoding: Tensor = self.dropout(self.context(torch.cat(parts, dim=1)))
        return encoding

    def decode(self, encoding: Tensor, features: Features, context: Context) -> Modes:
        """Return every mode's path and standard deviations in the agent's frame."""
        hidden = F.relu(encoding[:, None] + self.modes)
        hidden = hidden + F.relu(self.propose_hidden(hidden))
        proposed = self.propose(hidden)
        start, controls = proposed[..., :2], proposed[..., 2:].unflatten(-1, (STEPS, 2))
        scale = controls.new_tensor(_CONTROL_SCALE)
        speed = features["speed"][:, None]
        heading = _MAX_HEADING_CORRECTION * torch.tanh(start[..., 0])
        speed = speed + _MAX_SPEED_CORRECTION * torch.tanh(start[..., 1])
        proposal = drive(controls * scale, heading, speed)
        read = self._read(proposal, features, context)
        refined = F.relu(self.refine_hidden(torch.cat([hidden, read.flatten(2)], dim=-1)))
        controls = controls + self.refine(refined).unflatten(-1, (STEPS, 2))
        path = drive(controls * scale, heading, speed)
        usual = self.width.new_tensor(_USUAL_LOG_SIGMA)
        sigma = (usual + self.sigma(refined).unflatten(-1, (STEPS, 2)).clamp(-4, 4)).exp()
        logits = self.logits(refined)[..., 0] + self.mode_logits(encoding.relu())
        start = torch.stack([heading, speed], dim=-1)
        return Modes(logits, proposal, path, sigma, controls * scale, start)

    def covariance(self, modes: Modes, turned: Tensor | None = None) -> Tensor:
        """Return the covariances, at least the floor: [N, K, T, 2, 2], m².

        Args:
            modes: modes of N agents.
            turned: [N] rad, headings of the agents in the frame of the result; None: it is the agent's own.
        """
        along, across = modes.sigma.square().unbind(-1)
        scale = self.width.square()
        along, across = scale * along + self.variance_floor, scale * across + self.variance_floor
        heading = modes.path.heading if turned is None else modes.path.heading + turned[:, None, None]
        cos, sin = heading.cos(), heading.sin()
        xx = cos.square() * along + sin.square() * across
        yy = sin.square() * along + cos.square() * across
        xy = cos * sin * (along - across)
        covariance: Tensor = torch.stack([xx, xy, xy, yy], dim=-1).unflatten(-1, (2, 2))
        return covariance

    def forward(self, features: Features, context: Context, steps: int) -> tuple[Tensor, Positions]:
        """Return log-probabilities of the modes [N, K], and their positions relative to now, ground frame.

        Raises:
            ValueError: there are more steps than the network decodes.
        """
        if steps > STEPS:
            raise ValueError(f"this network forecasts {STEPS} steps, not {steps}")
        network, context = self.branch(context)
        modes = network.decode(network.encode(features, context), features, context)
        x, y = modes.path.x, modes.path.y
        heading = features["heading"]
        # Written out: products of thousands of 2 × 2 matrices take a fifth of a forward
        cos, sin = (part.to(x.dtype)[:, None, None] for part in (heading.cos(), heading.sin()))
        mean = torch.stack([cos * x - sin * y, sin * x + cos * y], dim=-1)[:, :, :steps]
        covariance = network.covariance(modes, heading.to(x.dtype))[:, :, :steps]
        return F.log_softmax(modes.logits / network.temperature, dim=-1), Positions(mean, covariance)

    def _read(self, path: Path, features: Features, context: Context) -> Tensor:
        """Return the encoding of map and neighbours at every other step of each mode: [N, K, T/2, 32].

        No gradient reaches the path. Each part has its own linear layer: concatenating the parts first would
        take longer than the products.
        """
        x, y, heading, speed = (part.detach()[..., _READ_EVERY - 1 :: _READ_EVERY] for part in path)
        where = torch.stack([x / 30, y / 30, heading, speed / 15], dim=-1)
        read: Tensor = self.read_state(where)
        if context is not Context.FULL:
            return F.relu(read, inplace=True)
        if self.read_map is not None:
            lateral = x.new_tensor(_READ_LATERAL_M).repeat(len(_READ_AHEAD_M))
            ahead = x.new_tensor(_READ_AHEAD_M).repeat_interleave(len(_READ_LATERAL_M))
            cos, sin = heading.cos()[..., None], heading.sin()[..., None]
            px = x[..., None] + cos * ahead - sin * lateral
            py = y[..., None] + sin * ahead + cos * lateral
            layers = read_patch(features["far_map"], px, py, FAR)  # [N, 3, K, T, P]
            for layer, values in zip(self.read_map, layers.unbind(1), strict=True):
                # One product of all rows; of the strided parts there would be one for each agent and mode
                read = read + layer(values.flatten(0, -2)).view_as(read)
        if self.read_neighbors is not None:
            read = read + self.read_neighbors(_in_the_way(Path(x, y, heading, speed), features))
        return F.relu(read, inplace=True)


class NeighborEncoder(nn.Module):
    """Attention of an agent over its neighbours: [N, M, D] → [N, 64].

    Each neighbour is a token of its state in the agent's frame; the query is the own history. A learned token
    stands for "nobody", so that the absence of neighbours is information, too.
    """

    def __init__(self, heads: int = 4) -> None:
        super().__init__()
        self.heads = heads
        self.token = nn.Sequential(
            nn.Linear(NEIGHBOR_FEATURES + 2, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, _WIDTH)
        )
        self.nobody = nn.Parameter(torch.zeros(_WIDTH))
        self.query = nn.Linear(_WIDTH, _WIDTH)
        self.key_value = nn.Linear(_WIDTH, 2 * _WIDTH)
        self.out = nn.Linear(_WIDTH, _WIDTH)

    def forward(self, neighbors: Tensor, present: Tensor, own: Tensor) -> Tensor:
        """Return the neighbours' influence: [N, 64].

        Args:
            neighbors: [N, M, D].
            present: [N, M] bool, False in the padding.
            own: [N, 64], the encoded history.
        """
        count = own.shape[0]
        # The lane of a near neighbour matters by the metre, that of a far one little
        lane = torch.tanh(neighbors[..., :2] * (NEIGHBOR_POSITION_SCALE / neighbors.new_tensor(_NEAR_M)))
        tokens = F.relu(self.token(torch.cat([neighbors, lane], dim=-1)))
        tokens = torch.cat([self.nobody.expand(count, 1, -1), tokens], dim=1)
        there = torch.cat([present.new_ones(count, 1), present], dim=1)
        key, value = self.key_value(tokens).chunk(2, dim=-1)
        query = self.query(own).view(count, self.heads, 1, -1)
        key = key.unflatten(-1, (self.heads, -1)).transpose(1, 2)
        value = value.unflatten(-1, (self.heads, -1)).transpose(1, 2)
        scores = (query * key).sum(-1) / math.sqrt(key.shape[-1])  # [N, heads, 1 + M]
        weights = scores.masked_fill(~there[:, None], -math.inf).softmax(dim=-1)
        influence: Tensor = F.relu(self.out((weights[..., None] * value).sum(2).flatten(1)))
        return influence


class MapEncoder(nn.Module):
    """Convolutions over a map patch: [N, 3, 100, 100] in [-1, 1], 0 unknown → [N, 64]."""

    def __init__(self, dropout: float) -> None:
        super().__init__()
        self.convs = nn.ModuleList(
            [
                nn.Conv2d(3, 32, 5, stride=5),
                nn.Conv2d(32, 48, 3, stride=2, padding=1),
                nn.Conv2d(48, 48, 3, padding=1),
                nn.Conv2d(48, 48, 3, stride=2, padding=1),
            ]
        )
        self.project = nn.Linear(48 * 5 * 5, _WIDTH)
        self.dropout = nn.Dropout(dropout)
        self.training_dtype = torch.float32
        """Type of the convolutions in training."""

    def forward(self, patches: Tensor) -> Tensor:
        patches = patches.contiguous(memory_format=torch.channels_last)
        if self.training and self.training_dtype is not torch.float32:
            with torch.autocast(patches.device.type, self.training_dtype):
                patches = self._convolved(patches).to(self.project.weight.dtype)
        else:
            patches = self._convolved(patches)
        encoded: Tensor = self.dropout(F.relu(self.project(patches.flatten(1))))
        return encoded

    def _convolved(self, patches: Tensor) -> Tensor:
        for conv in self.convs:
            patches = F.relu(conv(patches), inplace=True)
        return patches


def _neighbors(features: Features, full: bool) -> tuple[Tensor, Tensor]:
    """Return neighbours [N, M, D], and which are present [N, M]; blind: one absent neighbour."""
    neighbors = features["neighbors"] if full else features["history"].new_zeros(1, 1, NEIGHBOR_FEATURES)
    if not full:
        neighbors = neighbors.expand(features["history"].shape[0], -1, -1)
    return neighbors, neighbors[..., -1] > 0


def drive(controls: Tensor, heading: Tensor, speed: Tensor) -> Path:
    """Integrate the paths of a unicycle by the midpoint rule; an agent that drives ahead never reverses.

    Args:
        controls: [N, K, T, 2], heading rate (rad/s) and acceleration (m/s²).
        heading: [N, K] rad, now.
        speed: [N, K] m/s, now.
    """
    dt = STEP_SECONDS
    turned, gained = (dt * controls.cumsum(dim=2)).unbind(-1)
    phi, v = heading[..., None] + turned, speed[..., None] + gained
    v = torch.where((speed > _DRIVES_AHEAD)[..., None], F.relu(v), v)
    middle = phi - 0.5 * dt * controls[..., 0]
    mean_speed = 0.5 * (torch.cat([speed[..., None], v[..., :-1]], dim=-1) + v)
    x = dt * (mean_speed * middle.cos()).cumsum(dim=2)
    y = dt * (mean_speed * middle.sin()).cumsum(dim=2)
    return Path(x, y, phi, v)


def read_patch(patches: Tensor, x: Tensor, y: Tensor, geometry: PatchGeometry) -> Tensor:
    """Sample a patch's layers at points in its agent's frame, bilinearly; 0 (unknown) outside.

    Args:
        patches: [N, 3, S, S].
        x: [N, …] m ahead.
        y: [N, …] m to the left.
        geometry: geometry of the patches.

    Returns:
        [N, 3, …].
    """
    size = geometry.size
    row = (x * geometry.pixels_per_meter + geometry.rows_behind + 0.5) * (2 / size) - 1
    column = (y * geometry.pixels_per_meter + geometry.columns_right + 0.5) * (2 / size) - 1
    grid = torch.stack([column, row], dim=-1).flatten(1, -2)[:, None]  # [N, 1, P, 2]
    values: Tensor = F.grid_sample(patches, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    layers: Tensor = values.unflatten(-1, x.shape[1:])[:, :, 0]
    return layers


def _in_the_way(path: Path, features: Features) -> Tensor:
    """Return the degree to which neighbours of constant velocity are in the way of each mode: [N, K, T', 3].

    Between one read step and the next, in the frame of the path there: the presence of a neighbour on the
    path, narrowly and widely, and the nearness of one ahead.
    """
    neighbors = features["neighbors"]
    ahead, aside, gone = _beside(path, neighbors, _READ_EVERY)
    there = (neighbors[..., -1] > 0)[:, None, :, None].to(ahead.dtype)
    passed = _reached(ahead, gone) * there
    narrow, wide = ((-aside.square() / (2 * width**2)).exp() for width in (_NARROW_M, _WIDE_M))
    following = torch.sigmoid(ahead + _HALF_LENGTH_M) * (-F.relu(ahead) / _GAP_M).exp() * there
    met = (narrow * passed, wide * passed, narrow * following)
    return torch.stack([one.amax(dim=2) for one in met], dim=-1)


def drives_through(path: Path, neighbors: Tensor) -> Tensor:
    """Return the degree, 0 to 1, to which modes drive through neighbours of constant velocity: [N, K, M].

    Args:
        path: path of all steps.
        neighbors: [N, M, 11]; results for padding are meaningless.
    """
    ahead, aside, gone = _beside(path, neighbors, 1)
    through: Tensor = ((-aside.square() / (2 * _NARROW_M**2)).exp() * _reached(ahead, gone)).amax(dim=-1)
    return through


def _beside(path: Path, neighbors: Tensor, every: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return positions of neighbours of constant velocity in the frame of a path at each of its steps.

    Args:
        path: path at each ``every``-th step.
        neighbors: [N, M, 11].
        every: number of 0.5 s steps between the path's steps.

    Returns:
        Distances ahead and to the left, [N, K, M, T'] each, m; the path's length since its previous step,
        [N, K, 1, T'], m.
    """
    x, y, heading, _ = path
    steps = torch.arange(every, STEPS + 1, every, dtype=x.dtype, device=x.device)
    seconds = STEP_SECONDS * steps
    position = NEIGHBOR_POSITION_SCALE * neighbors[:, :, None, 0:2]
    place = (
        position + NEIGHBOR_VELOCITY_SCALE * neighbors[:, :, None, 4:6] * seconds[:, None]
    )  # [N, M, T', 2]
    east = place[:, None, ..., 0] - x[:, :, None]  # [N, K, M, T']
    north = place[:, None, ..., 1] - y[:, :, None]
    cos, sin = heading.cos()[:, :, None], heading.sin()[:, :, None]
    gone = torch.hypot(
        torch.diff(x, prepend=torch.zeros_like(x[..., :1])),
        torch.diff(y, prepend=torch.zeros_like(y[..., :1])),
    )[:, :, None].detach()  # a length has no gradient at zero
    return cos * east + sin * north, cos * north - sin * east, gone


def _reached(ahead: Tensor, gone: Tensor) -> Tensor:
    """Return the degree, 0 to 1, to which a neighbour is met between a step and the previous one."""
    return torch.sigmoid(ahead + gone + _HALF_LENGTH_M) * torch.sigmoid(_HALF_LENGTH_M - ahead)
