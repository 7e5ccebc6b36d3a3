"""Terms of the evidence lower bound (ELBO) of a conditional variational autoencoder, in one context.

Trajectron++ (Salzmann et al. 2020, section 4.4) adds a mutual-information term to it (InfoVAE, Zhao et al.
2019).
"""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from model.features.standardization import FUTURE_POSITION_SCALE
from model.forecaster import Context, Features
from model.mixture import guarded_log_density
from model.networks.cvae import AgentNetwork

MIN_KL = 0.07
"""nats, lower clamp of the divergence (free bits)."""


class ContextTerms(NamedTuple):
    """Unweighted terms of one context."""

    prior_logits: Tensor
    """[N, K], of p(z | x), clipped."""
    posterior_logits: Tensor
    """[N, K], of q(z | x, y), clipped."""
    step_density: Tensor
    """[N, K, T], log-density of the true position under each mode, 1/m² inside the log."""
    displacement: Tensor
    """[N, K, T], m, from each mode's mean to the true position."""

    @property
    def log_prior(self) -> Tensor:
        """[N, K], log p(z | x)."""
        return F.log_softmax(self.prior_logits, -1)

    @property
    def log_posterior(self) -> Tensor:
        """[N, K], log q(z | x, y)."""
        return F.log_softmax(self.posterior_logits, -1)


def context_terms(
    network: AgentNetwork,
    features: Features,
    future: Tensor,
    context: Context,
    logit_clip: float,
    detach_encoding: bool = False,
    sample_controls: bool = True,
) -> ContextTerms:
    """Return the terms of one context.

    Args:
        network: in training mode for dropout.
        features: of N agents.
        future: [N, T, 2], m, relative to now.
        context: full or blind.
        logit_clip: bound of the latent logits.
        detach_encoding: whether the gradient stops at the encoding.
        sample_controls: whether the decoder feeds back samples of its controls instead of their means.
    """
    encoding = network.encode(features, context)
    if detach_encoding:
        encoding = encoding.detach()
    scale = FUTURE_POSITION_SCALE[network.agent_type]
    prior = network.prior(encoding, context).clamp(-logit_clip, logit_clip)
    posterior = network.posterior(encoding, features, future / scale, context).clamp(-logit_clip, logit_clip)
    positions = network.decode(encoding, features, context, future.shape[1], sample_controls)
    offset = future[:, None] - positions.mean
    density = guarded_log_density(offset, positions.covariance)
    return ContextTerms(prior, posterior, density, offset.norm(dim=-1))


def expected_displacement(log_prior: Tensor, displacement: Tensor) -> Tensor:
    """Return the distance from the truth, expected under the prior, summed over the steps: [N], m.

    Args:
        log_prior: [N, K], log p(z | x).
        displacement: [N, K, T], m.
    """
    return (log_prior.exp() * displacement.sum(dim=-1)).sum(dim=-1)


def log_likelihood(
    log_weights: Tensor, step_density: Tensor, lower: float | None, upper: float | None
) -> Tensor:
    """Return log p(y | x), modes weighted at each step, each step clamped, summed over the steps: [N], nats.

    Args:
        log_weights: [N, K], log-probabilities of the modes; in training those of q(z | x, y).
        step_density: [N, K, T].
        lower: minimum of a step's log-likelihood; None: no clamp.
        upper: maximum; None: no clamp.
    """
    steps = torch.logsumexp(log_weights[:, :, None] + step_density, dim=1)
    if lower is not None or upper is not None:
        steps = steps.clamp(lower, upper)
    return steps.sum(dim=-1)


def divergence(log_q: Tensor, log_p: Tensor) -> Tensor:
    """Return KL(q ‖ p), averaged over the batch: [], nats.

    Args:
        log_q: [N, K], log-probabilities.
        log_p: [N, K], log-probabilities.
    """
    return F.kl_div(log_p, log_q, reduction="batchmean", log_target=True)


def clamped_divergence(log_q: Tensor, log_p: Tensor) -> Tensor:
    """Return KL(q ‖ p), averaged over the batch and then clamped from below (free bits): [], nats."""
    return divergence(log_q, log_p).clamp_min(MIN_KL)


def mutual_information(log_prior: Tensor) -> Tensor:
    """Return I(z; x) under the prior: entropy of the batch-mean p(z | x) minus the mean entropy: [], nats.

    Args:
        log_prior: [N, K], log p(z | x).
    """
    prior = log_prior.exp()
    mean = prior.mean(dim=0)
    return -torch.xlogy(mean, mean).sum() + (prior * log_prior).sum(dim=-1).mean()
