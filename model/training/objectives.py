"""Objectives of the methods with a CVAE; all train the same network (Ben-Younes et al. 2022, section 3).

CAB's KL term, the divergence of full and blind latents that it maximises, is ``cab_kl``. The objective
``cab`` uses it in the ground frame, ``model.training.mixture_objective`` in the agent's frame.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from model.forecaster import Context, Features
from model.networks.cvae import AgentNetwork
from model.training.elbo import (
    ContextTerms,
    clamped_divergence,
    context_terms,
    divergence,
    expected_displacement,
    log_likelihood,
    mutual_information,
)


@dataclass(frozen=True)
class LossWeights:
    """Weights of the objectives' terms at one step, and how the decoder is fed."""

    kl: float
    logit_clip: float
    sample_controls: bool = True
    min_step_likelihood: float = -6.0
    """nats, lower clamp of a step's log-likelihood in CAB, Reweight and RUBiZ. As released, −6: a worse step
    then has no gradient."""
    displacement: float = 0.0
    """1/m, weight of ``elbo.expected_displacement``; 0, as released, leaves it out."""
    blind_kl: float = 5.0
    """λ_KL, weight of ``cab_kl``; as released, 5."""


class Loss(NamedTuple):
    """A loss and its terms for the log."""

    value: Tensor
    terms: dict[str, Tensor]


Objective = Callable[[AgentNetwork, Features, Tensor, LossWeights], Loss]
"""(network, features, future [N, T, 2] in m relative to now, weights) → loss."""

MAX_STEP_LIKELIHOOD = 6.0
"""nats, upper clamp of a step's log-likelihood, so that standing agents do not dominate the loss."""
RUBIZ_FULL = 0.1
"""Weight of the full log-likelihood in RUBiZ."""


def trajectron(network: AgentNetwork, features: Features, future: Tensor, weights: LossWeights) -> Loss:
    """Return the loss of Trajectron++, with or without context (the network's configuration decides)."""
    full = _terms(network, features, future, Context.FULL, weights)
    bound = _bound(full, weights, clamped=False)
    return Loss(bound.value(), bound.named())


def cab(network: AgentNetwork, features: Features, future: Tensor, weights: LossWeights) -> Loss:
    """Return the loss of CAB: ELBOs with full and with null context, minus the weighted KL term ``cab_kl``.

    As released, the gradient stops at the blind encoding.
    """
    full, blind = _full_and_blind(network, features, future, weights)
    bounds = [_bound(terms, weights) for terms in (full, blind)]
    kl = cab_kl(full.log_prior, blind.log_prior)
    value = bounds[0].value() + bounds[1].value() - weights.blind_kl * kl
    return Loss(value, bounds[0].named("full") | bounds[1].named("blind") | {"kl_full_blind": kl})


def cab_kl(full_log_prior: Tensor, blind_log_prior: Tensor) -> Tensor:
    """Return CAB's KL term, KL(p(z | x) ‖ p(z | blind x)), averaged over the batch: [], nats.

    CAB maximises it, with weight λ_KL, so that the latents of the full context differ from those of the blind
    forecast (Ben-Younes et al. 2022, section 3.3). No gradient reaches the blind latents.

    Args:
        full_log_prior: [N, K], log p(z | x) with full context.
        blind_log_prior: [N, K], log p(z | blind x).
    """
    return divergence(full_log_prior, blind_log_prior.detach())


def reweight(network: AgentNetwork, features: Features, future: Tensor, weights: LossWeights) -> Loss:
    """Return the loss of Reweight: agents that the blind forecast misses weigh more."""
    full, blind = _full_and_blind(network, features, future, weights)
    bounds = [_bound(terms, weights) for terms in (full, blind)]
    share = torch.sigmoid(-bounds[1].likelihood).detach()
    value = bounds[0].value() + bounds[1].value() - (share * bounds[0].likelihood).mean()
    return Loss(value, bounds[0].named("full") | bounds[1].named("blind") | {"share": share.mean()})


def rubiz(network: AgentNetwork, features: Features, future: Tensor, weights: LossWeights) -> Loss:
    """Return the loss of RUBiZ: the fused latents of both contexts have to explain the future, too."""
    full, blind = _full_and_blind(network, features, future, weights)
    fused = fused_terms(full, blind)
    bounds = {
        name: _bound(terms, weights) for name, terms in (("full", full), ("blind", blind), ("fused", fused))
    }
    value = bounds["full"].value(RUBIZ_FULL) + bounds["blind"].value() + bounds["fused"].value()
    return Loss(
        value, {key: term for name, bound in bounds.items() for key, term in bound.named(name).items()}
    )


def fused_log_weights(full: Tensor, blind: Tensor) -> Tensor:
    """Return log-probabilities of RUBiZ's fused latents: [N, K].

    Args:
        full: [N, K], log p(z | x).
        blind: [N, K], log p(z | blind x).
    """
    return F.log_softmax(full.sigmoid() * blind.sigmoid(), dim=-1)


def fused_terms(full: ContextTerms, blind: ContextTerms) -> ContextTerms:
    """Return RUBiZ's fused latents of both contexts, with the positions of the full one.

    Logits are σ(l)·σ(l̃); as released, the l are normalised: log p(z | ·).
    """
    return ContextTerms(
        full.log_prior.sigmoid() * blind.log_prior.sigmoid(),
        full.log_posterior.sigmoid() * blind.log_posterior.sigmoid(),
        full.step_density,
        full.displacement,
    )


OBJECTIVES: dict[str, Objective] = {
    "trajectron": trajectron,
    "trajectron-no-context": trajectron,
    "cab": cab,
    "reweight": reweight,
    "rubiz": rubiz,
    "halentnet": trajectron,
    "halentnet-no-context": trajectron,
}
"""Objectives by the method's name; for HalentNet, that of its CVAE step."""


class _Bound(NamedTuple):
    """The evidence lower bound of one context."""

    likelihood: Tensor
    """[N], log p(y | x)."""
    kl: Tensor
    information: Tensor
    displacement: Tensor | None
    """m; None: it has no weight."""
    weights: LossWeights

    def value(self, likelihood_weight: float = 1.0) -> Tensor:
        """Return the negative bound, to be minimised."""
        value = -likelihood_weight * self.likelihood.mean() + self.weights.kl * self.kl - self.information
        return value if self.displacement is None else value + self.weights.displacement * self.displacement

    def named(self, context: str = "") -> dict[str, Tensor]:
        """Return the terms for the log."""
        suffix = f"_{context}" if context else ""
        terms = {"log_likelihood": self.likelihood.mean(), "kl": self.kl}
        terms["mutual_information"] = self.information
        if self.displacement is not None:
            terms["displacement"] = self.displacement
        return {name + suffix: term.detach() for name, term in terms.items()}


def _bound(terms: ContextTerms, weights: LossWeights, clamped: bool = True) -> _Bound:
    log_prior, log_posterior = terms.log_prior, terms.log_posterior
    lower = weights.min_step_likelihood if clamped else None
    displaced = expected_displacement(log_prior, terms.displacement).mean() if weights.displacement else None
    return _Bound(
        log_likelihood(log_posterior, terms.step_density, lower, MAX_STEP_LIKELIHOOD),
        clamped_divergence(log_posterior, log_prior),
        mutual_information(log_prior),
        displaced,
        weights,
    )


def _terms(
    network: AgentNetwork,
    features: Features,
    future: Tensor,
    context: Context,
    weights: LossWeights,
    detach_encoding: bool = False,
) -> ContextTerms:
    return context_terms(
        network,
        features,
        future,
        context,
        weights.logit_clip,
        detach_encoding=detach_encoding,
        sample_controls=weights.sample_controls,
    )


def _full_and_blind(
    network: AgentNetwork, features: Features, future: Tensor, weights: LossWeights
) -> tuple[ContextTerms, ContextTerms]:
    """Return full and blind terms; as released, no gradient reaches the encoder through the blind ones."""
    full = _terms(network, features, future, Context.FULL, weights)
    blind = _terms(network, features, future, Context.BLIND, weights, detach_encoding=True)
    return full, blind
