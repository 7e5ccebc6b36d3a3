"""The objective of networks in the agent's frame."""

import math

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from loadtest.forward import features_in_agent_frame
from model.features.agent_features import NEIGHBOR_POSITION_SCALE, NEIGHBOR_VELOCITY_SCALE
from model.features.spec import Frame
from model.forecaster import Context, Features
from model.networks.agent_frame import STEPS, AgentFrameNetwork
from model.networks.config import BlindContext, NetworkConfig
from model.training.config import Method, MixtureWeights
from model.training.mixture_objective import mixture_objective, step_log_density

CONFIG = NetworkConfig(frame=Frame.AGENT, far_map=True, blind=BlindContext.NULL, modes=12)
NOTHING = dict.fromkeys(
    ("nll", "joint_nll", "min_ade", "classification", "expected_ade", "off_road", "proposal", "blind_kl"), 0.0
)


@pytest.fixture
def network() -> AgentFrameNetwork:
    torch.manual_seed(2)
    return AgentFrameNetwork(CONFIG).eval()


@pytest.fixture
def features() -> Features:
    return features_in_agent_frame(5)


@pytest.fixture
def future() -> Tensor:
    steps = torch.arange(1, STEPS + 1)
    return torch.stack([2.0 * steps, 0.1 * steps.square()], dim=-1).expand(5, STEPS, 2)


def only(**weights: float) -> MixtureWeights:
    """Return weights of which all others are zero."""
    return MixtureWeights.model_validate(NOTHING | weights)


def value(network: AgentFrameNetwork, features: Features, future: Tensor, weights: MixtureWeights) -> Tensor:
    return mixture_objective(network, features, future, weights, Method.TRAJECTRON).value


def reference(
    network: AgentFrameNetwork, features: Features, future: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return probabilities [N, K], distances [N, K, T] and log-densities [N, K, T] of the forward itself."""
    turned = features | {"heading": torch.zeros(len(future), dtype=torch.float64)}
    with torch.no_grad():
        log_weights, positions = network(turned, Context.FULL, STEPS)
    distance = (positions.mean - future[:, None]).norm(dim=-1)
    normal = MultivariateNormal(positions.mean.double(), positions.covariance.double())
    return log_weights.exp(), distance, normal.log_prob(future[:, None].double())


def test_each_term_by_itself(network: AgentFrameNetwork, features: Features, future: Tensor) -> None:
    weights, distance, density = reference(network, features, future)
    mean = distance.mean(dim=-1)
    score = mean + 0.5 * distance[..., -1]
    ranked = weights.argsort(dim=1, descending=True)
    rows = torch.arange(5)
    expected = {
        "nll": -torch.logsumexp(weights.double().log()[..., None] + density, dim=1).mean(),
        "joint_nll": -torch.logsumexp(weights.double().log() + density.sum(-1), dim=1).mean() / STEPS,
        "min_ade": mean[rows, score.argmin(dim=1)].mean(),
        "most_likely_ade": mean[rows, ranked[:, 0]].mean(),
        "expected_ade": (weights * mean).sum(dim=1).mean(),
        "classification": -((-score).softmax(dim=1) * weights.log()).sum(dim=1).mean(),
    }
    for count in (5, 10):
        first = ranked[:, :count]
        chosen = first.gather(1, score.gather(1, first).argmin(dim=1, keepdim=True))
        expected[f"min_ade_{count}"] = mean.gather(1, chosen).mean()
    for name, wanted in expected.items():
        got = value(network, features, future, only(**{name: 1.0}))
        assert got.item() == pytest.approx(wanted.item(), rel=2e-3, abs=2e-3), name


def test_density_has_the_floor(network: AgentFrameNetwork, features: Features, future: Tensor) -> None:
    with torch.no_grad():
        network.sigma.bias.fill_(-50.0)
        modes = network.decode(network.encode(features, Context.FULL), features, Context.FULL)
        there = torch.stack([modes.path.x[:, 0], modes.path.y[:, 0]], dim=-1)
        density = step_log_density(network, modes, there)[:, 0]
    # On the mean of a mode as narrow as can be: 0.1 m at 1 s, 0.3 m at 6 s
    least = torch.tensor([0.1, 0.3])
    narrowest = -2 * least.log() - math.log(2 * math.pi)
    assert (density[:, [1, 11]] <= narrowest + 1e-3).all()
    assert (density[:, [1, 11]] > narrowest - 0.5).all()


def test_the_likeliest_is_pulled_without_moving_probabilities(
    network: AgentFrameNetwork, features: Features, future: Tensor
) -> None:
    value(network, features, future, only(most_likely_ade=1.0)).backward()
    assert network.propose.weight.grad is not None
    assert network.propose.weight.grad.abs().max() > 0
    for head in (network.logits, network.mode_logits):
        assert head.weight.grad is None or head.weight.grad.abs().max() == 0


def test_the_expected_distance_moves_probabilities(
    network: AgentFrameNetwork, features: Features, future: Tensor
) -> None:
    value(network, features, future, only(expected_ade=1.0)).backward()
    assert network.mode_logits.weight.grad is not None
    assert network.mode_logits.weight.grad.abs().max() > 0


def test_off_road_is_the_share_of_the_steps_there(
    network: AgentFrameNetwork, features: Features, future: Tensor
) -> None:
    for level, wanted in ((-1.0, 1.0), (1.0, 0.0), (0.0, 0.0)):
        map_of = features | {"far_map": torch.full_like(features["far_map"], level)}
        modes = network.decode(network.encode(map_of, Context.FULL), map_of, Context.FULL)
        inside = (modes.path.x < 55) & (modes.path.x > -5) & (modes.path.y.abs() < 30)
        got = value(network, map_of, future, only(off_road=1.0)).item()
        assert got == pytest.approx(wanted, abs=0.0 if inside.all() and not wanted else 0.35)


def test_cab_adds_its_blind_forecast_and_presses_apart(
    network: AgentFrameNetwork, features: Features, future: Tensor
) -> None:
    plain = only(nll=1.0)
    full = value(network, features, future, plain).item()
    loss = mixture_objective(network, features, future, plain.model_copy(update={"blind": 0.5}), Method.CAB)
    blind = loss.terms["nll_blind"].item()
    assert loss.value.item() == pytest.approx(full + 0.5 * blind, rel=1e-5)
    apart = mixture_objective(
        network, features, future, plain.model_copy(update={"blind": 0.0, "blind_kl": 2.0}), Method.CAB
    )
    assert apart.terms["kl_full_blind"].item() > 0
    assert apart.value.item() == pytest.approx(full - 2 * apart.terms["kl_full_blind"].item(), rel=1e-4)


def test_a_part_of_the_batch_may_be_forecast_blindly(
    network: AgentFrameNetwork, features: Features, future: Tensor
) -> None:
    weights = only(nll=1.0, blind=1.0, blind_share=0.4)
    some = {name: values[:2] for name, values in features.items()}
    part = mixture_objective(network, features, future, weights, Method.CAB).terms["nll_blind"]
    whole = mixture_objective(network, some, future[:2], only(nll=1.0), Method.CAB).terms["nll_blind"]
    assert part.item() == pytest.approx(whole.item(), rel=1e-5)


@pytest.fixture
def branched() -> AgentFrameNetwork:
    torch.manual_seed(3)
    return AgentFrameNetwork(CONFIG.model_copy(update={"blind": BlindContext.OWN})).eval()


def blind_terms(network: AgentFrameNetwork, features: Features, future: Tensor) -> tuple[Tensor, Tensor]:
    """Return the blind branch's log-weights [N, K] and log-densities [N, K, T], from the forward itself."""
    turned = features | {"heading": torch.zeros(len(future), dtype=torch.float64)}
    log_weights, positions = network(turned, Context.BLIND, STEPS)
    normal = MultivariateNormal(positions.mean.double(), positions.covariance.double())
    return log_weights.double(), normal.log_prob(future[:, None].double())


def test_reweight_counts_more_what_its_blind_branch_misses(
    branched: AgentFrameNetwork, features: Features
) -> None:
    with torch.no_grad():
        turned = features | {"heading": torch.zeros(5, dtype=torch.float64)}
        near = branched(turned, Context.BLIND, STEPS)[1].mean[:, 0]
        future = near + torch.linspace(0.0, 4.0, 5)[:, None, None]  # from well forecast to missed
        log_weights, density = blind_terms(branched, features, future)
        missed = torch.logsumexp(log_weights[..., None] + density, dim=1).mean(dim=-1)
        weights, _, densities = reference(branched, features, future)
        likelihood = torch.logsumexp(weights.double().log()[..., None] + densities, dim=1).mean(dim=-1)
        loss = mixture_objective(branched, features, future, only(nll=1.0, blind=0.0), Method.REWEIGHT)
    expected = -((1 + torch.sigmoid(-missed)) * likelihood).mean()
    assert loss.value.item() == pytest.approx(expected.item(), rel=1e-3)
    assert 0.3 < loss.terms["share"] < 0.99


def test_reweights_share_has_no_gradient(
    branched: AgentFrameNetwork, features: Features, future: Tensor
) -> None:
    mixture_objective(branched, features, future, only(nll=1.0, blind=0.0), Method.REWEIGHT).value.backward()
    assert branched.blind_network is not None
    assert all(p.grad is None or p.grad.abs().max() == 0 for p in branched.blind_network.parameters())


def test_rubiz_fuses_the_latents_of_both_contexts(
    branched: AgentFrameNetwork, features: Features, future: Tensor
) -> None:
    with torch.no_grad():
        blind, _ = blind_terms(branched, features, future)
        weights, _, densities = reference(branched, features, future)
        full = weights.double().log()
        fused = (full.sigmoid() * blind.sigmoid()).log_softmax(dim=-1)
        by = [-torch.logsumexp(one[..., None] + densities, dim=1).mean().item() for one in (full, fused)]
        loss = mixture_objective(branched, features, future, only(nll=1.0, blind=0.0), Method.RUBIZ)
    assert loss.terms["nll_fused"].item() == pytest.approx(by[1], rel=1e-3)
    assert loss.value.item() == pytest.approx(0.1 * by[0] + by[1], rel=1e-3)


def test_the_fused_latent_teaches_both_branches(
    branched: AgentFrameNetwork, features: Features, future: Tensor
) -> None:
    mixture_objective(branched, features, future, only(nll=1.0, blind=0.0), Method.RUBIZ).value.backward()
    assert branched.blind_network is not None
    for network in (branched, branched.blind_network):
        assert network.mode_logits.weight.grad is not None
        assert network.mode_logits.weight.grad.abs().max() > 0


def with_one_neighbor(features: Features, x: float, y: float, vx: float) -> Features:
    """Return features in which everyone's only neighbour is at that place, m and m/s in the own frame."""
    neighbors = torch.zeros_like(features["neighbors"])
    neighbors[:, 0, 0], neighbors[:, 0, 1] = x / NEIGHBOR_POSITION_SCALE, y / NEIGHBOR_POSITION_SCALE
    neighbors[:, 0, 4] = vx / NEIGHBOR_VELOCITY_SCALE
    neighbors[:, 0, 2] = neighbors[:, 0, 8] = neighbors[:, 0, 10] = 1.0
    return features | {"neighbors": neighbors}


def test_collision_is_the_probability_of_driving_through_what_stands(
    network: AgentFrameNetwork, features: Features
) -> None:
    with torch.no_grad():
        for head in (network.propose, network.refine):
            head.weight.zero_()
            head.bias.zero_()
    features = features | {"speed": torch.full((5,), 10.0)}  # straight on, by every mode
    ahead = torch.stack([5.0 * torch.arange(1, STEPS + 1), torch.zeros(STEPS)], dim=-1)
    stops = torch.minimum(ahead, ahead.new_tensor([14.0, 0.0]))

    def collision(x: float, y: float, vx: float, future: Tensor) -> float:
        met = with_one_neighbor(features, x, y, vx)
        with torch.no_grad():
            return value(network, met, future.expand(5, STEPS, 2), only(collision=1.0)).item()

    assert collision(24.0, 0.0, 0.0, stops) > 0.9
    assert 0.2 < collision(24.0, 1.5, 0.0, stops) < 0.6  # half in the lane
    assert collision(24.0, 3.5, 0.0, stops) < 0.03  # in the next lane
    assert collision(-9.0, 0.0, 0.0, stops) < 0.05  # behind
    assert collision(24.0, 0.0, 4.0, stops) == 0.0  # it drives
    assert collision(24.0, 0.0, 0.0, ahead) == 0.0  # it left: the truth goes there


def test_collision_moves_paths_and_probabilities(network: AgentFrameNetwork, features: Features) -> None:
    met = with_one_neighbor(features | {"speed": torch.full((5,), 10.0)}, 25.0, 0.0, 0.0)
    value(network, met, torch.zeros(5, STEPS, 2), only(collision=1.0)).backward()
    for head in (network.propose, network.mode_logits):
        assert head.weight.grad is not None
        assert torch.isfinite(head.weight.grad).all()
        assert head.weight.grad.abs().max() > 0
