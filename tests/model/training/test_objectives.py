"""Objectives against the reference's losses and gradients (golden/losses).

The reference's own float32 rounding at slow turns (see test_parity) moves its losses by up to 2 % and its
gradients by more; in the same arithmetic, which ``Released`` puts in, ours come out as its do, as far as its
rounding lets one see.
"""

import json
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor

from model.convert.tensor_names import our_name, rename
from model.forecaster import Context, Features
from model.networks import cvae as network_module
from model.networks.config import BlindContext, NetworkConfig
from model.networks.cvae import AgentNetwork
from model.scenes.scene import AgentType
from model.training.elbo import (
    MIN_KL,
    clamped_divergence,
    context_terms,
    divergence,
    expected_displacement,
    log_likelihood,
    mutual_information,
)
from model.training.objectives import OBJECTIVES, Loss, LossWeights, fused_terms
from tests.model.networks.golden import golden_features
from tests.model.networks.released import FLOAT32_ROUNDING, Released
from tests.model.training.fakes import MadeUpPairs

METHODS = {
    "trajectron": BlindContext.NONE,
    "cab": BlindContext.NULL,
    "reweight": BlindContext.OWN,
    "rubiz": BlindContext.OWN,
}
TERMS = {
    "trajectron": {
        "log_likelihood": "log_likelihood",
        "kl": "kl",
        "mutual_information": "mutual_information_p",
    },
    "cab": {
        "log_likelihood_full": "ll_full",
        "log_likelihood_blind": "ll_so",
        "kl_full": "kl_full",
        "kl_blind": "kl_state",
        "mutual_information_blind": "mutual_information_p_so",
        "kl_full_blind": "kl_full_state",
    },
    "reweight": {
        "log_likelihood_full": "ll_full",
        "log_likelihood_blind": "ll_so",
        "kl_full": "kl_full",
        "kl_blind": "kl_state",
    },
    "rubiz": {
        "log_likelihood_full": "ll_full",
        "log_likelihood_blind": "ll_so",
        "log_likelihood_fused": "ll_fused",
        "kl_full": "kl_full",
        "kl_blind": "kl_state",
        "kl_fused": "kl_fused",
    },
}
"""Our terms by the golden files' names."""
WITHIN_ONE_PERCENT = {"trajectron": 0.85, "cab": 0.95, "reweight": 0.8, "rubiz": 0.8}
"""Share of the gradients, at least."""
if torch.backends.cpu.get_cpu_capability() == "AVX2":
    # Narrower registers sum in another order, and Trajectron++'s gradients hang on rounding the most: 49 of
    # 59 are within 1 % there, and with every step rounded anew 8 to 21 are
    WITHIN_ONE_PERCENT["trajectron"] = 0.83
NEXT_TO_NOTHING = 3e-3
"""Share of the greatest gradient's norm."""


class Golden(NamedTuple):
    """One of golden/losses: a network, what it is given, and what came out in the reference."""

    method: str
    network: AgentNetwork
    features: Features
    future: Tensor
    weights: LossWeights
    loss: float
    terms: dict[str, float]
    norms: dict[str, float]
    """Norms of the gradients, by our names."""
    none: set[str]
    """Our parameters that have none there."""

    def compute(self) -> Loss:
        """Compute our loss; its gradients are in the network."""
        self.network.zero_grad(set_to_none=True)
        loss = OBJECTIVES[self.method](self.network, self.features, self.future, self.weights)
        loss.value.backward()
        return loss

    def gradients(self) -> dict[str, Tensor | None]:
        """Return our gradients by our names."""
        return {name: parameter.grad for name, parameter in self.network.named_parameters()}

    def ratios(self) -> NDArray[np.float64]:
        """Return norms of our gradients, by the reference's, in the order of ``norms``."""
        self.compute()
        ours = self.gradients()
        return np.array(
            [cast("Tensor", ours[name]).norm().item() / norm for name, norm in self.norms.items()]
        )


@pytest.fixture(params=METHODS)
def golden(shared: Path, request: pytest.FixtureRequest) -> Golden:
    """Return the golden values of each method."""
    method, folder = str(request.param), shared / "reference/golden/losses"
    file = json.loads((folder / f"{method}.json").read_text())
    tensors = rename(load_file(folder / f"{method}.safetensors"))
    network = AgentNetwork(NetworkConfig(blind=METHODS[method]), AgentType.VEHICLE)
    network.load_state_dict({name.removeprefix("vehicle."): t for name, t in tensors.items()})
    network.eval()  # the golden losses are without dropout
    features = golden_features(folder / "inputs.npz", AgentType.VEHICLE)
    future = torch.from_numpy(np.load(folder / "inputs.npz")["future"]) - features["origin"][:, None]
    weights = LossWeights(file["kl_weight"], file["z_logit_clip"], sample_controls=False)
    norms: dict[str, float] = {}
    none: set[str] = set()
    for name, norm in file["grad_norms"].items():
        ours = our_name(name)
        if ours is None:
            assert norm is None, name  # what we leave out has no gradient there
        elif norm is None:
            none.add(ours.removeprefix("vehicle."))
        else:
            norms[ours.removeprefix("vehicle.")] = norm
    return Golden(
        method, network, features, future.float(), weights, file["loss"], file["terms"], norms, none
    )


@pytest.fixture
def released(golden: Golden, monkeypatch: pytest.MonkeyPatch) -> Released:
    """Put the released arithmetic in place of ours."""
    integrate = Released(golden.features["origin"])
    monkeypatch.setattr(network_module, "integrate_unicycle", integrate)
    return integrate


@pytest.mark.usefixtures("released")
def test_losses_and_terms(golden: Golden) -> None:
    loss = golden.compute()
    assert loss.value.item() == pytest.approx(golden.loss, rel=1e-3)
    for ours, theirs in TERMS[golden.method].items():
        assert loss.terms[ours].item() == pytest.approx(golden.terms[theirs], rel=1e-3, abs=1e-6), ours


def test_gradients_reach_what_they_reach_in_the_reference(golden: Golden) -> None:
    golden.compute()
    ours = golden.gradients()
    assert {name for name, gradient in ours.items() if gradient is None} == golden.none
    assert set(ours) == golden.none | set(golden.norms)


def test_gradient_norms(golden: Golden, released: Released) -> None:
    """To 1 %, or as near as the reference's own rounding lets one tell, up to 10 %.

    How far that moves each norm is measured: in eight runs every intermediate result of the integration is
    rounded anew. Gradients of next to nothing, which are what cancellation left over, may be off by more.
    """
    ours = golden.ratios()
    released.rounding = FLOAT32_ROUNDING
    released.generator.manual_seed(0)
    runs = np.stack([ours, *(golden.ratios() for _ in range(8))])
    spread = np.ptp(runs, axis=0)
    off = np.abs(ours - 1)
    names = np.array(list(golden.norms))
    norms = np.array(list(golden.norms.values()))
    most = np.where(norms > NEXT_TO_NOTHING * norms.max(), 0.1, np.inf)
    assert not names[off > np.maximum(0.01, np.minimum(spread, most))].tolist()
    # With random weights a vehicle's degenerate covariances can make half of a gradient; that must stay rare
    assert (off < 0.01).mean() >= WITHIN_ONE_PERCENT[golden.method]


@pytest.mark.parametrize("golden", ["cab", "reweight", "rubiz"], indirect=True)
def test_losses_with_our_own_integration(golden: Golden) -> None:
    """Methods that clamp the steps reach the golden loss without the reference's rounding, too."""
    assert golden.compute().value.item() == pytest.approx(golden.loss, rel=1e-3)


@pytest.mark.parametrize("golden", ["rubiz"], indirect=True)
def test_rubiz_fuses_normalised_logits(golden: Golden) -> None:
    """The latents are compared before the floor of their divergence, which hides them in ``kl_fused``."""
    with torch.no_grad():
        full, blind = (
            context_terms(
                golden.network,
                golden.features,
                golden.future,
                context,
                golden.weights.logit_clip,
                sample_controls=False,
            )
            for context in (Context.FULL, Context.BLIND)
        )
        fused = fused_terms(full, blind)
        divergence_of_fused = divergence(fused.log_posterior.double(), fused.log_prior.double()).item()
    assert divergence_of_fused == pytest.approx(golden.terms["true_kl"], rel=1e-2)


def test_divergence_has_a_floor_but_keeps_its_value_above() -> None:
    logits = torch.tensor([[2.0, 0.0, -2.0]]).log_softmax(-1)
    assert clamped_divergence(logits, logits).item() == pytest.approx(MIN_KL)
    other = torch.tensor([[-2.0, 0.0, 2.0]]).log_softmax(-1)
    expected = (logits.exp() * (logits - other)).sum().item()
    assert clamped_divergence(logits, other).item() == pytest.approx(expected)


def test_mutual_information_is_greatest_when_every_agent_has_a_mode_of_its_own() -> None:
    own = (torch.eye(4) * 50).log_softmax(-1)
    assert mutual_information(own).item() == pytest.approx(np.log(4), abs=1e-5)
    same = torch.zeros(4, 4).log_softmax(-1)
    assert mutual_information(same).item() == pytest.approx(0, abs=1e-6)


def test_log_likelihood_is_clamped_step_by_step() -> None:
    density = torch.tensor([[[100.0, -100.0, 1.0]]])
    weight = torch.zeros(1, 1)
    assert log_likelihood(weight, density, -6.0, 6.0).item() == pytest.approx(6 - 6 + 1)
    assert log_likelihood(weight, density, None, 6.0).item() == pytest.approx(6 - 100 + 1)
    assert log_likelihood(weight, density, None, None).item() == pytest.approx(1)


def test_expected_displacement_by_hand() -> None:
    """Two modes of probabilities 1/4 and 3/4, off by 1 m and 2 m, and by 0 and 4 m."""
    log_prior = torch.tensor([[0.25, 0.75]]).log()
    displacement = torch.tensor([[[1.0, 2.0], [0.0, 4.0]]])
    assert expected_displacement(log_prior, displacement).tolist() == [pytest.approx(0.25 * 3 + 0.75 * 4)]


@pytest.mark.parametrize("method", METHODS)
def test_the_displacement_counts_as_much_as_it_weighs(method: str) -> None:
    """In every context that the method has."""
    torch.manual_seed(0)
    network = AgentNetwork(NetworkConfig(blind=METHODS[method], modes=3), AgentType.VEHICLE).eval()
    source = MadeUpPairs(6)
    given, future = source.batch(torch.arange(6))

    def loss(weight: float) -> Loss:
        weights = LossWeights(1.0, 5.0, sample_controls=False, displacement=weight)
        return OBJECTIVES[method](network, given, future, weights)

    without, light, heavy = loss(0.0), loss(1.0), loss(2.5)
    assert not [name for name in without.terms if name.startswith("displacement")]
    added = sum(term for name, term in light.terms.items() if name.startswith("displacement"))
    assert added > 1.0
    torch.testing.assert_close(light.value, without.value + added)
    torch.testing.assert_close(heavy.value, without.value + 2.5 * added)
    heavy.value.backward()
    assert network.prior_logits.weight.grad is not None
    assert network.prior_logits.weight.grad.norm() > 0


def test_cab_presses_full_and_blind_apart_as_much_as_it_weighs() -> None:
    torch.manual_seed(0)
    network = AgentNetwork(NetworkConfig(blind=BlindContext.NULL, modes=3), AgentType.VEHICLE).eval()
    given, future = MadeUpPairs(6).batch(torch.arange(6))
    released, light = (
        OBJECTIVES["cab"](network, given, future, LossWeights(1.0, 5.0, sample_controls=False, **weight))
        for weight in ({}, {"blind_kl": 0.5})
    )
    apart = released.terms["kl_full_blind"]
    assert apart > 0
    torch.testing.assert_close(light.value - released.value, 4.5 * apart)
