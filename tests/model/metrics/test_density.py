import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.metrics import density
from model.mixture import TrajectoryMixture
from tests.model.metrics.builders import certain, random_mixture

seeds = st.integers(0, 10_000)


def _one(variance: float = 1.0, modes: int = 1) -> TrajectoryMixture:
    """Return equal round Gaussians at (100, −50), one step."""
    return TrajectoryMixture(
        torch.zeros(1, modes).log_softmax(-1),
        torch.zeros(1, modes, 1, 2),
        variance * torch.eye(2).expand(1, modes, 1, 2, 2),
        torch.tensor([[100.0, -50.0]], dtype=torch.float64),
    )


def _points(mixture: TrajectoryMixture, seed: int) -> np.ndarray:
    agents, _, steps = mixture.means.shape[:3]
    spread = np.random.default_rng(seed).normal(scale=4, size=(agents, steps, 2))
    return np.asarray(mixture.origin.numpy()[:, None] + spread)


def test_by_hand() -> None:
    truth = np.array([[[103.0, -46.0]]])
    expected = math.log(2 * math.pi * 4) + 25 / 8
    assert density.nll(_one(4.0), truth).item() == pytest.approx(expected)
    assert density.joint_nll(_one(4.0), truth).item() == pytest.approx(expected)
    assert density.nll(_one(4.0, modes=3), truth).item() == pytest.approx(expected)
    widened = math.log(2 * math.pi * 4.25) + 25 / 8.5
    assert density.nll(_one(4.0), truth, noise_m=0.5).item() == pytest.approx(widened)


def test_a_mode_holds_for_the_whole_trajectory() -> None:
    """Two modes far apart: a truth that follows one of them has joint density ½, one that jumps has none."""
    means = torch.tensor([[[[0.0, 0.0]] * 2, [[100.0, 0.0]] * 2]])
    m = TrajectoryMixture(
        torch.full((1, 2), 0.5).log(),
        means,
        torch.eye(2).expand(1, 2, 2, 2, 2),
        torch.zeros(1, 2, dtype=torch.float64),
    )
    at_mean = math.log(2 * math.pi)
    follows, jumps = np.array([[[0.0, 0], [0, 0]]]), np.array([[[0.0, 0], [100, 0]]])
    assert density.joint_nll(m, follows).item() == pytest.approx(math.log(2) + 2 * at_mean)
    assert density.joint_nll(m, jumps).item() == pytest.approx(math.log(1) + 2 * at_mean + 5000)
    for truth in (follows, jumps):
        np.testing.assert_allclose(density.nll(m, truth), math.log(2) + at_mean)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_nll_is_the_mixtures(seed: int) -> None:
    m = random_mixture(seed)
    truth = _points(m, seed)
    np.testing.assert_allclose(density.nll(m, truth), -m.log_density(torch.from_numpy(truth)))
    by_mode = m.component_log_density(torch.from_numpy(truth)).sum(-1)
    np.testing.assert_allclose(density.joint_nll(m, truth), -torch.logsumexp(m.log_weights + by_mode, 1))
    one = random_mixture(seed, steps=1)
    point = _points(one, seed)
    np.testing.assert_allclose(density.joint_nll(one, point), density.nll(one, point)[:, 0])


def test_widening_makes_the_certain_finite() -> None:
    m = certain(random_mixture(1))
    truth = m.most_likely_trajectory().numpy() + 0.05
    assert np.isfinite(density.nll(m, truth, density.LABEL_NOISE_M)).all()
    assert np.isfinite(density.joint_nll(m, truth, density.LABEL_NOISE_M)).all()
    # Without it there is no density
    for values in (
        density.nll(m, truth),
        density.joint_nll(m, truth),
        density.density_rank(m, truth, [1, 2, 3]),
    ):
        assert np.isnan(values).all()
    m.covariances[:, :, 1:] = torch.eye(2, dtype=torch.float64)
    np.testing.assert_array_equal(np.isnan(density.nll(m, truth)), [[True] + [False] * 11] * 3)
    with pytest.raises(ValueError, match="noise"):
        density.widened(m, -0.1)
    assert density.widened(m, 0).means.dtype == torch.float64


def test_one_mode_has_an_ellipse() -> None:
    for level in density.LEVELS:
        radius = math.sqrt(-2 * math.log(1 - level)) * 2
        for scale, inside in ((0.999, 1), (1.001, 0)):
            truth = np.array([[[100.0 + radius * scale, -50.0]]])
            rank = density.density_rank(_one(4.0), truth, [0])
            assert density.inside_region(rank, level).item() == inside


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_drawn_ranks_are_those_of_the_ellipse(seed: int) -> None:
    single = random_mixture(seed, modes=1)
    twice = TrajectoryMixture(
        torch.full((3, 2), 0.5, dtype=torch.float64).log(),
        single.means.expand(-1, 2, -1, -1),
        single.covariances.expand(-1, 2, -1, -1, -1),
        single.origin,
    )
    truth = single.sample(1, [1, 2, 3])[:, 0].numpy()
    exact = density.density_rank(single, truth, [])
    drawn = density.density_rank(twice, truth, [4, 5, 6], draws=4999)
    np.testing.assert_allclose(drawn, exact, atol=0.05)
    np.testing.assert_array_equal(drawn, density.density_rank(twice, truth, [4, 5, 6], draws=4999))
    np.testing.assert_array_equal(
        drawn[1:2], density.density_rank(twice[1:2], truth[1:2], [5], draws=4999), "hangs on the batch"
    )


@pytest.mark.parametrize("modes", [1, 6])
def test_truths_from_the_mixture_are_calibrated(modes: int) -> None:
    m = random_mixture(3, agents=1, modes=modes, steps=2)
    count = 4000
    truths = m.sample(count, [1])[0].numpy()
    many = m[torch.zeros(count, dtype=torch.long)]
    rank = density.density_rank(many, truths, range(100, 100 + count))
    assert ((rank >= 0) & (rank <= 1)).all()
    for level in density.LEVELS:
        tolerance = 4 * math.sqrt(level * (1 - level) / count)
        np.testing.assert_allclose(density.inside_region(rank, level).mean(axis=0), level, atol=tolerance)


def test_no_truth_no_rank() -> None:
    for modes in (1, 4):
        m = random_mixture(0, modes=modes)
        truth = m.most_likely_trajectory().numpy()
        truth[1, 3, 0], truth[2, 4, 1] = np.nan, np.inf
        rank = density.density_rank(m, truth, [1, 2, 3])
        for values in (rank, density.nll(m, truth), density.inside_region(rank, 0.9)):
            np.testing.assert_array_equal(np.argwhere(np.isnan(values)), [[1, 3], [2, 4]])
        np.testing.assert_array_equal(np.isnan(density.joint_nll(m, truth)), [False, True, True])
