"""HalentNet: Trajectron++ as the generator of a GAN with hallucinated latents.

Zhu et al., "HalentNet: Multimodal trajectory forecasting with hallucinative intents", ICLR 2021. The
hallucinated trajectories change their latent category on the way; they should look real and belong to
no category.
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
from model.training.objectives import Weights
from model.training.processes import average_gradients

STEPS = 12
DISCRIMINATOR_RATE = 2e-4
BETAS = (0.5, 0.999)
"""Of the discriminator's Adam."""
MAP_RATE_FACTOR = 0.4
"""Of the map encoder's learning rate: 0.0008 beside 0.002."""
CREATIVE_WEIGHT = 1.0
"""λ."""
FIRST_SWITCH, LAST_SWITCH = 5, 7
"""Steps (counted from 0) at which a hallucination changes its category."""


class HalentLearner(CvaeLearner):
    """One step: the discriminator, the generator against it, the CVAE; each on a batch of its own.

    Args:
        config: of the run.
        device: of the networks.
    """

    def __init__(self, config: TrainingConfig, device: torch.device) -> None:
        super().__init__(config, device)
        self._adversarial_size = min(config.adversarial_batch_size, config.batch_size)
        self.discriminator = Discriminator(STEPS, config.network.modes, config.precision.dtype).to(device)
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

    def step(self, batches: Sequence[Batch], weights: Weights, rate: float) -> dict[str, Tensor]:
        for_discriminator, for_generator, for_cvae = batches
        terms = self.learn_to_tell(for_discriminator, weights)
        terms |= self.learn_to_fool(for_generator, weights, rate)
        return terms | super().step([for_cvae], weights, rate)

    def learn_to_tell(self, batch: Batch, weights: Weights) -> dict[str, Tensor]:
        """The discriminator: least-squares GAN loss, and the category that made the fake."""
        with torch.no_grad():
            encoding = self.network.encode(batch.features, Context.FULL)
            latents = self._latents(encoding, batch, weights)
            fake = self.network.sample(encoding, batch.features, latents[:, None].expand(-1, STEPS))
        judged_fake, judged_real = self._judge(batch, fake), self._judge(batch, batch.future)
        told = 0.5 * ((judged_real.real - 1).square().mean() + judged_fake.real.square().mean())
        category = F.cross_entropy(judged_fake.latent_logits, latents)
        self.discriminator_optimizer.zero_grad(set_to_none=True)
        (told + category).backward()
        average_gradients(self.discriminator.parameters())
        self.discriminator_optimizer.step()
        return {"discriminator": told.detach(), "discriminator_latent": category.detach()}

    def learn_to_fool(self, batch: Batch, weights: Weights, rate: float) -> dict[str, Tensor]:
        """The generator: a plain sample and a hallucinated one, half each."""
        self.discriminator.requires_grad_(False)
        encoding = self.network.encode(batch.features, Context.FULL)
        latents = self._latents(encoding, batch, weights)
        plain = self.network.sample(encoding, batch.features, latents[:, None].expand(-1, STEPS))
        hallucinated = self.network.sample(encoding, batch.features, self.switched(latents))
        verdict, on_hallucinated = self._judge(batch, plain), self._judge(batch, hallucinated)
        fool = (verdict.real - 1).square().mean()
        category = F.cross_entropy(verdict.latent_logits, latents)
        fool_hallucinated = (on_hallucinated.real - 1).square().mean()
        creative = -F.log_softmax(on_hallucinated.latent_logits, dim=-1).mean()
        loss = 0.5 * (fool + category) + 0.5 * (fool_hallucinated + CREATIVE_WEIGHT * creative)
        self.descend(loss, rate)
        self.discriminator.requires_grad_(True)
        terms = {"fool": fool, "latent": category, "fool_hallucinated": fool_hallucinated}
        return {name: term.detach() for name, term in terms.items()} | {"creative": creative.detach()}

    @torch.no_grad()
    def _latents(self, encoding: Tensor, batch: Batch, weights: Weights) -> Tensor:
        """A category for each agent from q(z | x, y): [N]."""
        future = batch.future / FUTURE_POSITION_SCALE[AgentType.VEHICLE]
        logits = self.network.posterior(encoding, batch.features, future, Context.FULL)
        logits = logits.clamp(-weights.logit_clip, weights.logit_clip)
        return torch.multinomial(logits.softmax(dim=-1), 1)[:, 0]

    def switched(self, latents: Tensor) -> Tensor:
        """[N] → [N, T]: another category from a random step on."""
        modes = self.network.config.modes
        another = (latents + torch.randint_like(latents, 1, modes)) % modes
        step = torch.randint_like(latents, FIRST_SWITCH, LAST_SWITCH + 1)
        later = torch.arange(STEPS, device=latents.device) >= step[:, None]
        return torch.where(later, another[:, None], latents[:, None])

    def _judge(self, batch: Batch, path: Tensor) -> Verdict:
        """The discriminator on trajectories [N, T, 2], ground frame."""
        verdict: Verdict = self.discriminator(
            batch.features.get("map"), turned(path, -present_heading(batch.features))
        )
        return verdict

    def _groups(self) -> list[dict[str, object]]:
        """The map encoder has a rate of its own."""
        named = list(self.networks.named_parameters())
        slow = [parameter for name, parameter in named if ".map_encoder." in name]
        others = [parameter for name, parameter in named if ".map_encoder." not in name]
        if not slow:
            return super()._groups()
        return [{"params": others}, {"params": slow, "rate_factor": MAP_RATE_FACTOR}]
