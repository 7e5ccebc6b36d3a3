"""The conditional variational autoencoder, with a full and a blind context."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.features.standardization import STATE_SIZE
from model.forecaster import Context, Features
from model.networks.config import HIDDEN, BlindContext, NetworkConfig
from model.networks.decoder import ModeDecoder
from model.networks.dynamics import Controls, Positions, integrate_unicycle, integrate_velocity
from model.networks.encoders import FutureEncoder, HistoryEncoder, MapEncoder, NeighborEncoder
from model.scenes.scene import AgentType

PRIOR_DROPOUT = 0.1


class Branch(nn.Module):
    """The layers after an encoding: prior, posterior, decoder and, for a vehicle, heading correction."""

    def __init__(
        self, config: NetworkConfig, encoding_size: int, state_size: int, corrects_heading: bool
    ) -> None:
        super().__init__()
        modes = config.modes
        self.prior_hidden = nn.Linear(encoding_size, HIDDEN)
        self.prior_dropout = nn.Dropout(PRIOR_DROPOUT)
        self.posterior_logits = nn.Linear(encoding_size + 4 * HIDDEN, modes)
        self.decoder = ModeDecoder(modes, encoding_size, state_size, config.max_control_sigma)
        self.heading_correction = nn.Linear(encoding_size + 1, 1) if corrects_heading else None


class AgentNetwork(nn.Module):
    """The network of one agent type.

    Trajectron++ (Salzmann et al. 2020) and, with a blind context, CAB, Reweight and RUBiZ (Ben-Younes et
    al. 2022, section 3). The reference has one network per method; here only the objectives differ.
    """

    def __init__(self, config: NetworkConfig, agent_type: AgentType) -> None:
        super().__init__()
        self.config = config
        self.agent_type = agent_type
        state_size = STATE_SIZE[agent_type]
        vehicle = agent_type is AgentType.VEHICLE
        self.history_encoder = HistoryEncoder(state_size)
        self.neighbor_encoder = (
            NeighborEncoder(state_size, {kind: STATE_SIZE[kind] for kind in config.neighbor_types})
            if config.neighbor_types
            else None
        )
        self.map_encoder = MapEncoder() if config.looks_at_map(agent_type) else None
        self.future_encoder = FutureEncoder(state_size)
        self.prior_logits = nn.Linear(HIDDEN, config.modes)  # shared by both branches, as released
        self.full = Branch(config, config.encoding_size(agent_type), state_size, vehicle)
        own = config.blind is BlindContext.OWN
        self.blind = Branch(config, HIDDEN, state_size, vehicle) if own else None

    def branch(self, context: Context) -> Branch:
        """Return the branch that forecasts in that context.

        Raises:
            ValueError: the context is blind, and the network has no blind forecast.
        """
        if context is Context.FULL or self.config.blind is BlindContext.NULL:
            return self.full
        if self.blind is None:
            raise ValueError("this network has no blind forecast")
        return self.blind

    def encode(self, features: Features, context: Context) -> Tensor:
        """Return the encoding x of the features: [N, X]."""
        history, first = features["history"], features["first"]
        own: Tensor = self.history_encoder(history, first)
        if context is Context.BLIND and self.config.blind is BlindContext.OWN:
            return own
        parts = [own]
        if self.neighbor_encoder is not None:
            if context is Context.FULL:
                neighbors = {kind: features[f"neighbors.{kind.value}"] for kind in self.config.neighbor_types}
                influence = self.neighbor_encoder(neighbors, history, first, features["edge_mask"], own)
            else:
                influence = torch.zeros_like(own)
            parts.insert(0, influence)
        if self.map_encoder is not None:
            if context is Context.FULL:
                parts.append(self.map_encoder(features["map"]))
            else:
                parts.append(self.map_encoder.null(len(own)))
        return torch.cat(parts, dim=1)

    def prior(self, encoding: Tensor, context: Context) -> Tensor:
        """Return mean-centred logits of p(z | x): [N, K]."""
        branch = self.branch(context)
        hidden = branch.prior_dropout(F.relu(branch.prior_hidden(encoding)))
        return _centred(self.prior_logits(hidden))

    def posterior(self, encoding: Tensor, features: Features, future: Tensor, context: Context) -> Tensor:
        """Return mean-centred logits of q(z | x, y): [N, K].

        Args:
            encoding: [N, X], of the same context.
            features: the agents' features.
            future: [N, T, 2], positions relative to now, standardised.
            context: full or blind.
        """
        encoded = self.future_encoder(future, features["history"][:, -1])
        return _centred(self.branch(context).posterior_logits(torch.cat([encoding, encoded], dim=1)))

    def decode(
        self,
        encoding: Tensor,
        features: Features,
        context: Context,
        steps: int,
        sample_controls: bool = False,
    ) -> Positions:
        """Return positions of every mode, relative to now: means [N, K, T, 2], covariances [N, K, T, 2, 2].

        Args:
            encoding: [N, X], of the same context.
            features: the agents' features.
            context: full or blind.
            steps: T.
            sample_controls: whether to feed back samples of the controls instead of their means (training).
        """
        branch = self.branch(context)
        controls = branch.decoder(encoding, features["history"][:, -1], steps, sample_controls)
        return self._integrate(branch, controls, encoding, features)

    def sample(self, encoding: Tensor, features: Features, latents: Tensor) -> Tensor:
        """Sample one trajectory per agent in the full context, differentiably.

        Args:
            encoding: [N, X], of the full context.
            features: the agents' features.
            latents: [N, T] int64, the category at each step.

        Returns:
            [N, T, 2], m, relative to now.
        """
        controls = self.full.decoder.sample(encoding, features["history"][:, -1], latents)
        one, another = controls[:, None].unbind(dim=-1)  # one "mode" per agent
        none = torch.zeros_like(one)
        drawn = Controls(one, another, none, none, none)
        return self._integrate(self.full, drawn, encoding, features).mean[:, 0]

    def _integrate(
        self, branch: Branch, controls: Controls, encoding: Tensor, features: Features
    ) -> Positions:
        """Integrate controls [N, M, T] into positions."""
        if branch.heading_correction is None:
            return integrate_velocity(controls)
        velocity = features["velocity"]
        heading = torch.atan2(velocity[:, 1], velocity[:, 0])[:, None]
        heading = heading + torch.tanh(branch.heading_correction(torch.cat([encoding, heading], dim=1)))
        modes = controls.mean_0.shape[:2]
        speed = velocity.norm(dim=1, keepdim=True)
        return integrate_unicycle(controls, heading.expand(modes), speed.expand(modes))

    def forward(self, features: Features, context: Context, steps: int) -> tuple[Tensor, Positions]:
        """Return log-probabilities of the modes [N, K], and their positions."""
        encoding = self.encode(features, context)
        log_weights = F.log_softmax(self.prior(encoding, context), dim=-1)
        return log_weights, self.decode(encoding, features, context, steps)


def _centred(logits: Tensor) -> Tensor:
    return logits - logits.mean(dim=-1, keepdim=True)
