"""Training of HalentNet: Trajectron++ as the generator of a GAN with hallucinated latents.

Zhu et al., "HalentNet: Multimodal trajectory forecasting with hallucinative intents", ICLR 2021. Hallucinated
trajectories change their latent category on the way; they should look real and belong to no category.
"""

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from model.features.standardization import FUTURE_POSITION_SCALE
from model.forecaster import Context
from model.networks.covernet import present_heading, turned
from model.scenes.scene import AgentType
from model.training.config import TrainingConfig
from model.training.discriminator import Discriminator, Verdict
from model.training.learner import Batch, CvaeLearner
from model.training.objectives import LossWeights
from model.training.processes import average_gradients

STEPS = 12
DISCRIMINATOR_RATE = 2e-4
BETAS = (0.5, 0.999)
"""β of the discriminator's Adam."""
MAP_RATE_FACTOR = 0.4
"""Factor on the map encoder's learning rate: 0.0008 beside 0.002."""
CREATIVE_WEIGHT = 1.0
"""λ, weight of the uncertainty about the category of a hallucination."""
FIRST_SWITCH, LAST_SWITCH = 5, 7
"""Steps (counted from 0) at which a hallucination changes its category."""


class HalentLearner(CvaeLearner):
    """HalentNet; a step trains discriminator, generator and CVAE, each on a batch of its own.

    Args:
        config: settings of the run.
        device: device of the networks.
    """

    def __init__(self, config: TrainingConfig, device: torch.device) -> None:
        super().__init__(config, device)
        self._adversarial_size = min(config.adversarial_batch_size, config.batch_size)
        dtype = config.precision.dtype_on(device)
        self.discriminator = Discriminator(STEPS, config.network.modes, dtype).to(device)
        self.discriminator_optimizer = torch.optim.Adam(
            self.discriminator.parameters(), lr=DISCRIMINATOR_RATE, betas=BETAS
        )

    @property
    def batch_sizes(self) -> tuple[int, ...]:
        return (self._adversarial_size, self._adversarial_size, *super().batch_sizes)

    @property
    def others(self) -> Mapping[str, torch.nn.Module]:
        return {"discriminator": self.discriminator}

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        return {"optimizer": self.optimizer, "discriminator_optimizer": self.discriminator_optimizer}

    def step(self, batches: Sequence[Batch], weights: LossWeights, rate: float) -> dict[str, Tensor]:
        for_discriminator, for_generator, for_cvae = batches
        terms = self.train_discriminator(for_discriminator, weights)
        terms |= self.train_generator(for_generator, weights, rate)
        return terms | super().step([for_cvae], weights, rate)

    def train_discriminator(self, batch: Batch, weights: LossWeights) -> dict[str, Tensor]:
        """Train the discriminator: least-squares GAN loss, and the category of the fake."""
        with torch.no_grad():
            encoding = self.network.encode(batch.features, Context.FULL)
            latents = self._latents(encoding, batch, weights)
            fake = self.network.sample(encoding, batch.features, latents[:, None].expand(-1, STEPS))
        on_fake, on_real = self._discriminate(batch, fake), self._discriminate(batch, batch.future)
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
        encoding = self.network.encode(batch.features, Context.FULL)
        latents = self._latents(encoding, batch, weights)
        plain = self.network.sample(encoding, batch.features, latents[:, None].expand(-1, STEPS))
        hallucinated = self.network.sample(encoding, batch.features, self.switched(latents))
        on_plain = self._discriminate(batch, plain)
        on_hallucinated = self._discriminate(batch, hallucinated)
        fool = (on_plain.real - 1).square().mean()
        category = F.cross_entropy(on_plain.latent_logits, latents)
        fool_hallucinated = (on_hallucinated.real - 1).square().mean()
        creative = -F.log_softmax(on_hallucinated.latent_logits, dim=-1).mean()
        loss = 0.5 * (fool + category) + 0.5 * (fool_hallucinated + CREATIVE_WEIGHT * creative)
        self.descend(loss, rate)
        self.discriminator.requires_grad_(True)
        terms = {"fool": fool, "latent": category, "fool_hallucinated": fool_hallucinated}
        return {name: term.detach() for name, term in terms.items()} | {"creative": creative.detach()}

    @torch.no_grad()
    def _latents(self, encoding: Tensor, batch: Batch, weights: LossWeights) -> Tensor:
        """Draw a category for each agent from q(z | x, y): [N]."""
        future = batch.future / FUTURE_POSITION_SCALE[AgentType.VEHICLE]
        logits = self.network.posterior(encoding, batch.features, future, Context.FULL)
        logits = logits.clamp(-weights.logit_clip, weights.logit_clip)
        return torch.multinomial(logits.softmax(dim=-1), 1)[:, 0]

    def switched(self, latents: Tensor) -> Tensor:
        """Return categories that change at a random step: [N] → [N, T]."""
        modes = self.network.config.modes
        another = (latents + torch.randint_like(latents, 1, modes)) % modes
        step = torch.randint_like(latents, FIRST_SWITCH, LAST_SWITCH + 1)
        later = torch.arange(STEPS, device=latents.device) >= step[:, None]
        return torch.where(later, another[:, None], latents[:, None])

    def _discriminate(self, batch: Batch, path: Tensor) -> Verdict:
        """Return the discriminator's verdict on trajectories [N, T, 2], m, ground frame, relative to now."""
        verdict: Verdict = self.discriminator(
            batch.features.get("map"), turned(path, -present_heading(batch.features))
        )
        return verdict

    def _groups(self) -> list[dict[str, object]]:
        """Return two groups where there is a map encoder, which has a learning rate of its own."""
        named = list(self.networks.named_parameters())
        slow = [parameter for name, parameter in named if ".map_encoder." in name]
        others = [parameter for name, parameter in named if ".map_encoder." not in name]
        if not slow:
            return super()._groups()
        return [{"params": others}, {"params": slow, "rate_factor": MAP_RATE_FACTOR}]
