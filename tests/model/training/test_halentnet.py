"""HalentNet's steps: who learns from what."""

import math

import pytest
import torch

from loadtest.forward import features_in_agent_frame
from model.data.packing import pack_patches
from model.features.spec import Frame
from model.forecaster import Context
from model.networks.config import NetworkConfig
from model.networks.cvae import AgentNetwork
from model.scenes.scene import AgentType
from model.training.config import Method
from model.training.halentnet import FIRST_SWITCH, LAST_SWITCH, STEPS, HalentLearner
from model.training.learner import Batch
from model.training.objectives import LossWeights
from tests.model.training.fakes import MadeUpPairs, small_config

PAIRS = MadeUpPairs(48)
WEIGHTS = LossWeights(kl=1.0, logit_clip=5.0)


def batch(start: int) -> Batch:
    """Return four of the pairs."""
    return Batch(*PAIRS.batch(torch.arange(start, start + 4)))


@pytest.fixture
def learner() -> HalentLearner:
    torch.manual_seed(0)
    config = small_config(Method.HALENTNET, precision="float32", adversarial_batch_size=4)
    return HalentLearner(config, torch.device("cpu"))


def parameters(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Return copies; what a forward alone changes (spectral norms) is not among them."""
    return {name: parameter.detach().clone() for name, parameter in module.named_parameters()}


def same(module: torch.nn.Module, before: dict[str, torch.Tensor]) -> bool:
    """Return whether nothing was learned since."""
    return all(torch.equal(parameter, before[name]) for name, parameter in module.named_parameters())


def test_one_step_teaches_both_networks_and_names_its_terms(learner: HalentLearner) -> None:
    before = {name: parameters(module) for name, module in learner.modules().items()}
    terms = learner.step([batch(0), batch(16), batch(32)], WEIGHTS, 0.01)
    assert {"discriminator", "fool", "creative", "log_likelihood", "loss"} <= set(terms)
    assert all(torch.isfinite(term) for term in terms.values())
    assert not any(same(module, before[name]) for name, module in learner.modules().items())


def test_each_adversarial_part_teaches_its_own_network(learner: HalentLearner) -> None:
    generator, discriminator = parameters(learner.networks), parameters(learner.discriminator)
    learner.train_discriminator(batch(0), WEIGHTS)
    assert same(learner.networks, generator)
    assert not same(learner.discriminator, discriminator)
    discriminator = parameters(learner.discriminator)
    learner.train_generator(batch(16), WEIGHTS, 0.01)
    assert not same(learner.networks, generator)
    assert same(learner.discriminator, discriminator)


def test_the_discriminator_learns_to_tell(learner: HalentLearner) -> None:
    told = [learner.train_discriminator(batch(0), WEIGHTS)["discriminator"].item() for _ in range(6)]
    assert told[-1] < 0.5 * told[0]


def test_the_generator_learns_to_fool_and_leaves_the_discriminator_alone(learner: HalentLearner) -> None:
    for _ in range(10):
        learner.train_discriminator(batch(0), WEIGHTS)
    weights = {k: v.clone() for k, v in learner.discriminator.named_parameters()}
    learner.discriminator.eval()  # no power iterations
    fooled = []
    for _ in range(8):
        torch.manual_seed(1)  # the same samples and dropout each time
        fooled.append(learner.train_generator(batch(0), WEIGHTS, 0.003)["fool"].item())
    assert min(fooled[1:]) < 0.9 * fooled[0], fooled
    assert all(torch.equal(v, weights[k]) for k, v in learner.discriminator.named_parameters())
    assert all(v.requires_grad for v in learner.discriminator.parameters())


def test_the_map_encoder_has_a_rate_of_its_own(learner: HalentLearner) -> None:
    learner.step([batch(0), batch(16), batch(32)], WEIGHTS, 0.002)
    encoder = learner.networks.of(AgentType.VEHICLE).map_encoder
    assert encoder is not None
    slow = next(group for group in learner.optimizers["optimizer"].param_groups if "rate_factor" in group)
    assert slow["lr"] == pytest.approx(0.0008)
    assert {id(p) for p in slow["params"]} == {id(p) for p in encoder.parameters()}


def in_the_agents_frame() -> tuple[HalentLearner, Batch]:
    torch.manual_seed(0)
    network = NetworkConfig(frame=Frame.AGENT, far_map=True, modes=5)
    config = small_config(
        Method.HALENTNET, network=network, rotate=False, precision="float32", adversarial_batch_size=4
    )
    features = features_in_agent_frame(4)
    for name in ("map", "far_map"):
        features[name] = torch.from_numpy(pack_patches(features[name].numpy()))
    steps = torch.arange(1, STEPS + 1)
    future = torch.stack([2.0 * steps, 0.1 * steps.square()], dim=-1).expand(4, STEPS, 2)
    return HalentLearner(config, torch.device("cpu")), Batch(features, future)


def test_in_the_agents_frame_one_step_teaches_both_networks() -> None:
    learner, batch = in_the_agents_frame()
    before = {name: parameters(module) for name, module in learner.modules().items()}
    terms = learner.step([batch, batch, batch], WEIGHTS, 0.01)
    assert {"discriminator", "fool", "creative", "nll", "loss"} <= set(terms)
    assert all(torch.isfinite(term) for term in terms.values())
    assert not any(same(module, before[name]) for name, module in learner.modules().items())


def test_in_the_agents_frame_the_discriminator_cools_down_with_the_generator() -> None:
    learner, batch = in_the_agents_frame()
    full = small_config(Method.HALENTNET).learning_rate
    for share in (1.0, 0.1):
        learner.step([batch, batch, batch], WEIGHTS, share * full)
        (group,) = learner.discriminator_optimizer.param_groups
        assert group["lr"] == pytest.approx(share * 2e-4)


def test_in_the_agents_frame_a_hallucination_drives_by_the_controls_of_two_modes() -> None:
    learner, batch = in_the_agents_frame()
    learner.networks.eval()
    shown = learner.generator.show(batch)
    with torch.no_grad():
        modes = learner.generator.view(shown.features)
        paths = torch.stack([modes.path.x, modes.path.y], dim=-1)
        for z in range(5):
            one = torch.full((4, STEPS), z)
            drawn = learner.generator.sample(modes, shown.features, one)
            torch.testing.assert_close(drawn, paths[:, z], atol=1e-4, rtol=1e-4)
        switched = torch.where(torch.arange(STEPS) < 6, 0, 3).expand(4, STEPS)
        path = learner.generator.sample(modes, shown.features, switched)
    torch.testing.assert_close(path[:, :6], paths[:, 0, :6], atol=1e-4, rtol=1e-4)
    assert (path[:, -1] - paths[:, 0, -1]).norm(dim=-1).min() > 1e-3


def test_in_the_agents_frame_categories_are_drawn_from_the_posterior() -> None:
    learner, batch = in_the_agents_frame()
    learner.networks.eval()
    shown = learner.generator.show(batch)
    with torch.no_grad():
        modes = learner.generator.view(shown.features)
        there = torch.stack([modes.path.x[:, 2], modes.path.y[:, 2]], dim=-1)
        narrow = modes._replace(sigma=torch.full_like(modes.sigma, 0.01))
        drawn = learner.generator.latents(narrow, Batch(shown.features, there), WEIGHTS)
    assert drawn.tolist() == [2] * 4


def test_a_hallucination_changes_its_category_once_on_the_way(learner: HalentLearner) -> None:
    latents = torch.randint(0, 5, (500,))
    switched = learner.switched(latents)
    assert switched.shape == (500, STEPS)
    assert torch.equal(switched[:, FIRST_SWITCH - 1], latents)
    assert (switched[:, LAST_SWITCH] != latents).all()
    changes = (switched[:, 1:] != switched[:, :-1]).int()
    assert (changes.sum(dim=1) == 1).all()
    assert set((changes.argmax(dim=1) + 1).tolist()) == set(range(FIRST_SWITCH, LAST_SWITCH + 1))


def test_a_sample_of_one_category_is_that_mode_when_there_is_no_noise() -> None:
    torch.manual_seed(0)
    network = AgentNetwork(NetworkConfig(modes=5), AgentType.VEHICLE).eval()
    with torch.no_grad():
        network.full.decoder.log_sigma.weight.zero_()
        network.full.decoder.log_sigma.bias.fill_(-30.0)
        features = batch(0).features
        encoding = network.encode(features, Context.FULL)
        modes = network.decode(encoding, features, Context.FULL, STEPS).mean
        for z in range(5):
            path = network.sample(encoding, features, torch.full((4, STEPS), z))
            assert torch.allclose(path, modes[:, z], atol=1e-4)


def test_in_bfloat16_the_sample_stays_near() -> None:
    torch.manual_seed(0)
    network = AgentNetwork(NetworkConfig(modes=5), AgentType.VEHICLE)
    decoder = network.full.decoder
    features = batch(0).features
    with torch.no_grad():
        encoding = network.encode(features, Context.FULL)
        exact = decoder(encoding, features["history"][:, -1], STEPS).mean_1
        decoder.training_dtype = torch.bfloat16
        near = decoder(encoding, features["history"][:, -1], STEPS).mean_1
        assert near.dtype == torch.float32
        assert not torch.equal(near, exact)
        assert math.isclose((near - exact).abs().max().item(), 0.0, abs_tol=0.02)
        decoder.eval()  # low precision is for training alone
        assert torch.equal(decoder(encoding, features["history"][:, -1], STEPS).mean_1, exact)
