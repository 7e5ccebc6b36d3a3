"""Training of HalentNet: Trajectron++ as the generator of a GAN with hallucinated latents.

Zhu et al., "HalentNet: Multimodal trajectory forecasting with hallucinative intents", ICLR 2021. Hallucinated
trajectories change their latent category on the way; they should look real and belong to no category.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Generic, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.features.standardization import FUTURE_POSITION_SCALE
from model.forecaster import Context, Features
from model.networks.agent_frame import AgentFrameNetwork, Modes, drive
from model.networks.covernet import present_heading, turned
from model.networks.cvae import AgentNetwork
from model.scenes.scene import AgentType
from model.training.config import TrainingConfig
from model.training.discriminator import Discriminator, Verdict
from model.training.learner import AgentFrameLearner, Batch, CvaeLearner, Learner, perturbed, set_rate
from model.training.mixture_objective import step_log_density
from model.training.objectives import LossWeights
from model.training.processes import average_gradients

STEPS = 12
DISCRIMINATOR_RATE = 2e-4
"""Learning rate of the discriminator. In the agent's frame it warms up and cools down with the generator.
Otherwise it gets ahead of a generator that cools down, and drives it off its paths (docs/experiments.md)."""
BETAS = (0.5, 0.999)
"""β of the discriminator's Adam."""
MAP_RATE_FACTOR = 0.4
"""Factor on the map encoder's learning rate in the ground frame: 0.0008 beside 0.002."""
CREATIVE_WEIGHT = 1.0
"""λ, weight of the uncertainty about the category of a hallucination."""
FIRST_SWITCH, LAST_SWITCH = 5, 7
"""Steps (counted from 0) at which a hallucination changes its category."""

View = TypeVar("View")
"""Result of a generator for a batch, for all categories."""


class Generator(ABC, Generic[View]):
    """A network that draws trajectories of given latent categories."""

    @abstractmethod
    def show(self, batch: Batch) -> Batch:
        """Return a batch as the network is shown it in training."""

    @abstractmethod
    def view(self, features: Features) -> View:
        """Return what the network computes of the features, for ``latents`` and ``sample``."""

    @abstractmethod
    def latents(self, view: View, shown: Batch, weights: LossWeights) -> Tensor:
        """Draw a category for each agent from q(z | x, y): [N]."""

    @abstractmethod
    def sample(self, view: View, features: Features, latents: Tensor) -> Tensor:
        """Return a trajectory of the categories at each step [N, T], differentiable: [N, T, 2], m, in the
        agents' frames."""

    @abstractmethod
    def truth(self, shown: Batch) -> Tensor:
        """Return the true trajectories in the agents' frames: [N, T, 2], m."""


class GroundGenerator(Generator[Tensor]):
    """A CVAE of the ground frame; a view is the encoding."""

    def __init__(self, network: AgentNetwork) -> None:
        self._network = network

    def show(self, batch: Batch) -> Batch:
        return batch

    def view(self, features: Features) -> Tensor:
        return self._network.encode(features, Context.FULL)

    @torch.no_grad()
    def latents(self, view: Tensor, shown: Batch, weights: LossWeights) -> Tensor:
        future = shown.future / FUTURE_POSITION_SCALE[AgentType.VEHICLE]
        logits = self._network.posterior(view, shown.features, future, Context.FULL)
        logits = logits.clamp(-weights.logit_clip, weights.logit_clip)
        return torch.multinomial(logits.softmax(dim=-1), 1)[:, 0]

    def sample(self, view: Tensor, features: Features, latents: Tensor) -> Tensor:
        path = self._network.sample(view, features, latents)
        return turned(path, -present_heading(features))

    def truth(self, shown: Batch) -> Tensor:
        return turned(shown.future, -present_heading(shown.features))


class AgentFrameGenerator(Generator[Modes]):
    """A network of the agent's frame; a view is its modes.

    The network is a mixture with weights p(z | x), so q(z | x, y) is its posterior by Bayes' rule. A
    trajectory of changing categories drives by the controls of each step's category.
    """

    def __init__(self, network: AgentFrameNetwork, config: TrainingConfig) -> None:
        self._network = network
        self._config = config

    def show(self, batch: Batch) -> Batch:
        return perturbed(batch, self._config)

    def view(self, features: Features) -> Modes:
        return self._network.decode(self._network.encode(features, Context.FULL), features, Context.FULL)

    @torch.no_grad()
    def latents(self, view: Modes, shown: Batch, weights: LossWeights) -> Tensor:
        density = step_log_density(self._network, view, shown.future).sum(dim=-1)
        posterior = (F.log_softmax(view.logits, dim=-1) + density).softmax(dim=-1)
        return torch.multinomial(posterior, 1)[:, 0]

    def sample(self, view: Modes, features: Features, latents: Tensor) -> Tensor:
        index = latents[:, None, :, None].expand(-1, 1, -1, 2)
        controls = view.controls.gather(1, index)
        start = view.start.gather(1, latents[:, :1, None].expand(-1, 1, 2))
        path = drive(controls, start[..., 0], start[..., 1])
        return torch.stack([path.x[:, 0], path.y[:, 0]], dim=-1)

    def truth(self, shown: Batch) -> Tensor:
        return shown.future


class HalentLearner(Learner):
    """HalentNet; a step trains discriminator, generator and CVAE, each on a batch of its own.

    Args:
        config: settings of the run.
        device: device of the networks.
    """

    def __init__(self, config: TrainingConfig, device: torch.device) -> None:
        self.generator: Generator[Any]
        if config.in_agent_frame:
            agent_frame = AgentFrameLearner(config, device)
            self._learner: AgentFrameLearner | CvaeLearner = agent_frame
            self.generator = AgentFrameGenerator(agent_frame.network, config)
        else:
            ground = CvaeLearner(config, device, MAP_RATE_FACTOR)
            self._learner, self.generator = ground, GroundGenerator(ground.network)
        super().__init__(self._learner.networks)
        self._adversarial_size = min(config.adversarial_batch_size, config.batch_size)
        self._modes = config.network.modes
        self._full_rate = config.learning_rate if config.in_agent_frame else None
        dtype = config.precision.dtype_on(device)
        self.discriminator = Discriminator(STEPS, self._modes, dtype).to(device)
        self.discriminator_optimizer = torch.optim.Adam(
            self.discriminator.parameters(), lr=DISCRIMINATOR_RATE, betas=BETAS
        )

    @property
    def batch_sizes(self) -> tuple[int, ...]:
        return (self._adversarial_size, self._adversarial_size, *self._learner.batch_sizes)

    @property
    def others(self) -> Mapping[str, nn.Module]:
        return {"discriminator": self.discriminator}

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        return {**self._learner.optimizers, "discriminator_optimizer": self.discriminator_optimizer}

    def step(self, batches: Sequence[Batch], weights: LossWeights, rate: float) -> dict[str, Tensor]:
        for_discriminator, for_generator, for_cvae = batches
        if self._full_rate is not None:
            set_rate(self.discriminator_optimizer, DISCRIMINATOR_RATE * rate / self._full_rate)
        terms = self.train_discriminator(for_discriminator, weights)
        terms |= self.train_generator(for_generator, weights, rate)
        return terms | self._learner.step([for_cvae], weights, rate)

    def train_discriminator(self, batch: Batch, weights: LossWeights) -> dict[str, Tensor]:
        """Train the discriminator: least-squares GAN loss, and the category of the fake."""
        shown = self.generator.show(batch)
        with torch.no_grad():
            view = self.generator.view(shown.features)
            latents = self.generator.latents(view, shown, weights)
            fake = self.generator.sample(view, shown.features, latents[:, None].expand(-1, STEPS))
        on_fake = self._discriminate(shown, fake)
        on_real = self._discriminate(shown, self.generator.truth(shown))
        adversarial = 0.5 * ((on_real.real - 1).square().mean() + on_fake.real.square().mean())
        category = F.cross_entropy(on_fake.latent_logits, latents)
        self.discriminator_optimizer.zero_grad(set_to_none=True)
        (adversarial + category).backward()
        average_gradients(self.discriminator.parameters())
        self.discriminator_optimizer.step()
        return {"discriminator": adversarial.detach(), "discriminator_latent": category.detach()}

    def train_generator(self, batch: Batch, weights: LossWeights, rate: float) -> dict[str, Tensor]:
        """Train the generator: a plain sample and a hallucinated one, half each."""
        self.discriminator.requires_grad_(False)
        shown = self.generator.show(batch)
        view = self.generator.view(shown.features)
        latents = self.generator.latents(view, shown, weights)
        plain = self.generator.sample(view, shown.features, latents[:, None].expand(-1, STEPS))
        hallucinated = self.generator.sample(view, shown.features, self.switched(latents))
        on_plain = self._discriminate(shown, plain)
        on_hallucinated = self._discriminate(shown, hallucinated)
        fool = (on_plain.real - 1).square().mean()
        category = F.cross_entropy(on_plain.latent_logits, latents)
        fool_hallucinated = (on_hallucinated.real - 1).square().mean()
        creative = -F.log_softmax(on_hallucinated.latent_logits, dim=-1).mean()
        loss = 0.5 * (fool + category) + 0.5 * (fool_hallucinated + CREATIVE_WEIGHT * creative)
        self._learner.descend(loss, rate)
        self.discriminator.requires_grad_(True)
        terms = {"fool": fool, "latent": category, "fool_hallucinated": fool_hallucinated}
        return {name: term.detach() for name, term in terms.items()} | {"creative": creative.detach()}

    def switched(self, latents: Tensor) -> Tensor:
        """Return categories that change at a random step: [N] → [N, T]."""
        another = (latents + torch.randint_like(latents, 1, self._modes)) % self._modes
        step = torch.randint_like(latents, FIRST_SWITCH, LAST_SWITCH + 1)
        later = torch.arange(STEPS, device=latents.device) >= step[:, None]
        return torch.where(later, another[:, None], latents[:, None])

    def _discriminate(self, shown: Batch, path: Tensor) -> Verdict:
        """Return the discriminator's verdict on trajectories [N, T, 2], m, in the agents' frames."""
        verdict: Verdict = self.discriminator(shown.features.get("map"), path)
        return verdict
