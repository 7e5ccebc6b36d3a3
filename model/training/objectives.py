"""The objectives of the methods; the network is one and the same (Ben-Younes et al. 2022, section 3)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from model.forecaster import Context, Features
from model.networks.network import AgentNetwork
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
class Weights:
    """What changes over the steps, and how the decoder is fed."""

    kl: float
    logit_clip: float
    sample_controls: bool = True
    least_step_likelihood: float = -6.0
    """nats; in CAB, Reweight and RUBiZ a step's log-likelihood is clamped there from below. As released, −6:
    what is forecast worse than that then has no gradient."""
    displacement: float = 0.0
    """1/m, of ``elbo.expected_displacement``; 0, as released, leaves it out."""
    apart: float = 5.0
    """λ_KL of CAB: how much full and blind latents are pressed apart; as released, 5."""


class Loss(NamedTuple):
    """A loss and the terms that it is made of, for the log."""

    value: Tensor
    terms: dict[str, Tensor]


Objective = Callable[[AgentNetwork, Features, Tensor, Weights], Loss]
"""(network, features, future [N, T, 2] in m relative to now, weights) → loss."""

MOST_STEP_LIKELIHOOD = 6.0
"""nats; a step's log-likelihood is clamped there, so that standing agents do not take over the loss."""
RUBIZ_FULL = 0.1
"""RUBiZ's weight of the full log-likelihood."""


def trajectron(network: AgentNetwork, features: Features, future: Tensor, weights: Weights) -> Loss:
    """Trajectron++ (also without context: that is in the network's shape)."""
    full = _terms(network, features, future, Context.FULL, weights)
    bound = _bound(full, weights, bounded=False)
    return Loss(bound.value(), bound.named())


def cab(network: AgentNetwork, features: Features, future: Tensor, weights: Weights) -> Loss:
    """CAB: the same network on a null context, and full and blind latents pressed apart.

    As released, the gradient stops at the blind encoding.
    """
    full, blind = _both(network, features, future, weights)
    bounds = [_bound(terms, weights) for terms in (full, blind)]
    apart = divergence(full.log_prior, blind.log_prior.detach())
    value = bounds[0].value() + bounds[1].value() - weights.apart * apart
    return Loss(value, bounds[0].named("full") | bounds[1].named("blind") | {"kl_full_blind": apart})


def reweight(network: AgentNetwork, features: Features, future: Tensor, weights: Weights) -> Loss:
    """Reweight: agents that the blind forecast misses count more."""
    full, blind = _both(network, features, future, weights)
    bounds = [_bound(terms, weights) for terms in (full, blind)]
    share = torch.sigmoid(-bounds[1].likelihood).detach()
    value = bounds[0].value() + bounds[1].value() - (share * bounds[0].likelihood).mean()
    return Loss(value, bounds[0].named("full") | bounds[1].named("blind") | {"share": share.mean()})


def rubiz(network: AgentNetwork, features: Features, future: Tensor, weights: Weights) -> Loss:
    """RUBiZ: the latents of both contexts, fused, must explain the future, too."""
    full, blind = _both(network, features, future, weights)
    fused = fused_terms(full, blind)
    bounds = {
        name: _bound(terms, weights) for name, terms in (("full", full), ("blind", blind), ("fused", fused))
    }
    value = bounds["full"].value(RUBIZ_FULL) + bounds["blind"].value() + bounds["fused"].value()
    return Loss(
        value, {key: term for name, bound in bounds.items() for key, term in bound.named(name).items()}
    )


def fused_terms(full: ContextTerms, blind: ContextTerms) -> ContextTerms:
    """RUBiZ's latents, from both contexts; positions are the full one's.

    Logits are σ(l)·σ(l̃), where, as released, l are normalised ones, log p(z | ·).
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
"""By the method's name; of HalentNet, its CVAE step."""


class _Bound(NamedTuple):
    """The evidence lower bound of one context."""

    likelihood: Tensor
    """[N], log p(y | x)."""
    kl: Tensor
    information: Tensor
    displacement: Tensor | None
    """m; None: it has no weight."""
    weights: Weights

    def value(self, likelihood_weight: float = 1.0) -> Tensor:
        """What is minimised."""
        value = -likelihood_weight * self.likelihood.mean() + self.weights.kl * self.kl - self.information
        return value if self.displacement is None else value + self.weights.displacement * self.displacement

    def named(self, context: str = "") -> dict[str, Tensor]:
        """Its terms for the log."""
        suffix = f"_{context}" if context else ""
        terms = {"log_likelihood": self.likelihood.mean(), "kl": self.kl}
        terms["mutual_information"] = self.information
        if self.displacement is not None:
            terms["displacement"] = self.displacement
        return {name + suffix: term.detach() for name, term in terms.items()}


def _bound(terms: ContextTerms, weights: Weights, bounded: bool = True) -> _Bound:
    log_prior, log_posterior = terms.log_prior, terms.log_posterior
    least = weights.least_step_likelihood if bounded else None
    displaced = expected_displacement(log_prior, terms.displacement).mean() if weights.displacement else None
    return _Bound(
        log_likelihood(log_posterior, terms.step_density, least, MOST_STEP_LIKELIHOOD),
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
    weights: Weights,
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


def _both(
    network: AgentNetwork, features: Features, future: Tensor, weights: Weights
) -> tuple[ContextTerms, ContextTerms]:
    """Full and blind terms; as released, no gradient reaches the encoder through the blind ones."""
    full = _terms(network, features, future, Context.FULL, weights)
    blind = _terms(network, features, future, Context.BLIND, weights, detach_encoding=True)
    return full, blind
