import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from model.mixture import TrajectoryMixture, cholesky_2x2


def mixture(
    seed: int = 0, agents: int = 3, modes: int = 4, steps: int = 5, dtype: torch.dtype = torch.float64
) -> TrajectoryMixture:
    """One of random, well-conditioned Gaussians."""
    generator = torch.Generator().manual_seed(seed)
    shape = (agents, modes, steps)
    factor = torch.randn(*shape, 2, 2, generator=generator, dtype=dtype)
    return TrajectoryMixture(
        log_weights=torch.randn(agents, modes, generator=generator, dtype=dtype).log_softmax(-1),
        means=5 * torch.randn(*shape, 2, generator=generator, dtype=dtype),
        covariances=factor @ factor.mT + 0.2 * torch.eye(2, dtype=dtype),
        origin=100 * torch.randn(agents, 2, generator=generator, dtype=torch.float64),
    )


def _points(seed: int, agents: int, steps: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 4 * torch.randn(agents, steps, 2, generator=generator, dtype=torch.float64)


def _moved(given: TrajectoryMixture, offset: Tensor) -> TrajectoryMixture:
    return TrajectoryMixture(given.log_weights, given.means, given.covariances, given.origin + offset)


seeds = st.integers(0, 10_000)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_log_density_is_that_of_torch(seed: int) -> None:
    m = mixture(seed)
    positions = m.origin[:, None] + _points(seed + 1, 3, 5)
    weights = m.log_weights[:, None].expand(-1, 5, -1)
    gaussians = MultivariateNormal(m.world_means.transpose(1, 2), m.covariances.transpose(1, 2))
    expected = MixtureSameFamily(Categorical(logits=weights), gaussians).log_prob(positions)
    torch.testing.assert_close(m.log_density(positions), expected)
    components = gaussians.log_prob(positions[:, :, None]).transpose(1, 2)
    torch.testing.assert_close(m.component_log_density(positions), components)


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(-1e5, 1e5), st.floats(-1e5, 1e5))
def test_moving_the_world_moves_everything_along(seed: int, x: float, y: float) -> None:
    m = mixture(seed, dtype=torch.float32)
    offset = torch.tensor([x, y], dtype=torch.float64)
    moved, points = _moved(m, offset), m.origin[:, None] + _points(seed, 3, 5)
    torch.testing.assert_close(
        moved.log_density(points + offset), m.log_density(points), rtol=1e-4, atol=1e-4
    )
    torch.testing.assert_close(moved.sample(7, [1, 2, 3]) - offset, m.sample(7, [1, 2, 3]), rtol=0, atol=1e-8)
    torch.testing.assert_close(moved.moments()[0] - offset, m.moments()[0], rtol=0, atol=1e-8)
    torch.testing.assert_close(moved.moments()[1], m.moments()[1])
    torch.testing.assert_close(
        moved.most_likely_trajectory() - offset, m.most_likely_trajectory(), rtol=0, atol=1e-8
    )


def test_samples_have_the_moments_of_the_mixture() -> None:
    m = mixture(4, agents=2)
    drawn = m.sample(40_000, [11, 12])
    mean, covariance = m.moments()
    assert drawn.shape == (2, 40_000, 5, 2)
    torch.testing.assert_close(drawn.mean(1), mean, rtol=0, atol=0.15)
    for agent in range(2):
        for step in range(5):
            sampled = torch.cov(drawn[agent, :, step].T)
            torch.testing.assert_close(sampled, covariance[agent, step], rtol=0.05, atol=0.3)


def test_samples_follow_the_modes_by_weight() -> None:
    m = mixture(5, agents=1, modes=3)
    far = torch.tensor([0.0, 1e4, 2e4], dtype=torch.float64)[None, :, None, None]
    m = TrajectoryMixture(m.log_weights, m.means + far, m.covariances, torch.zeros(1, 2, dtype=torch.float64))
    modes = (m.sample(20_000, [3])[0, :, :, 0] / 1e4).round().long()
    assert (modes == modes[:, :1]).all()  # one mode for the whole trajectory
    shares = torch.bincount(modes[:, 0], minlength=3) / 20_000
    torch.testing.assert_close(shares.double(), m.weights[0], rtol=0, atol=0.015)


def test_an_agents_samples_hang_on_its_seed_alone() -> None:
    m = mixture(6)
    both = m.sample(10, [5, 6, 7])
    torch.testing.assert_close(m[1:2].sample(10, [6])[0], both[1], rtol=0, atol=0)
    assert not torch.equal(m.sample(10, [5, 8, 7])[1], both[1])
    with pytest.raises(ValueError, match="zip"):
        m.sample(10, [5])


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_most_likely_is_of_greatest_weight(seed: int) -> None:
    m = mixture(seed)
    best = m.most_likely()
    assert (m.weights.gather(1, best[:, None])[:, 0] == m.weights.max(1).values).all()
    trajectory = m.most_likely_trajectory()
    for agent, mode in enumerate(best.tolist()):
        torch.testing.assert_close(trajectory[agent], m.world_means[agent, mode])


def test_the_first_of_equal_weights_is_taken() -> None:
    m = mixture(1, agents=1, modes=3)
    log_weights = torch.tensor([[0.2, 0.4, 0.4]], dtype=torch.float64).log()
    assert TrajectoryMixture(log_weights, m.means, m.covariances, m.origin).most_likely().item() == 1


def test_weights_sum_to_one_and_slicing_keeps_agents_together() -> None:
    m = mixture(8)
    torch.testing.assert_close(m.weights.sum(1), torch.ones(3, dtype=torch.float64))
    assert len(m) == 3
    some = m[torch.tensor([2, 0])]
    assert len(some) == 2
    torch.testing.assert_close(some.world_means, m.world_means[[2, 0]])
    torch.testing.assert_close(m[1:].covariances, m.covariances[1:])


def test_moments_of_one_mode_are_that_modes() -> None:
    m = mixture(9, modes=1)
    mean, covariance = m.moments()
    torch.testing.assert_close(mean, m.world_means[:, 0])
    torch.testing.assert_close(covariance, m.covariances[:, 0])


@settings(max_examples=50, deadline=None)
@given(st.floats(0, 1e4), st.floats(0, 1e4), st.floats(-1, 1))
def test_cholesky(sx: float, sy: float, correlation: float) -> None:
    xy = sx * sy * correlation
    matrix = torch.tensor([[sx * sx, xy], [xy, sy * sy]], dtype=torch.float64)
    factor = cholesky_2x2(matrix)
    assert factor.isfinite().all()
    assert factor[0, 1] == 0
    np.testing.assert_allclose(factor @ factor.mT, matrix, rtol=1e-9, atol=1e-9 * (1 + sx * sx + sy * sy))


def test_a_certain_position_is_sampled_as_it_is() -> None:
    zero = torch.zeros(1, 1, 2, 2, 2)
    m = TrajectoryMixture(
        torch.zeros(1, 1), torch.ones(1, 1, 2, 2), zero, torch.full((1, 2), 3.0, dtype=torch.float64)
    )
    assert (m.sample(4, [0]) == 4).all()


def test_density_at_the_mean() -> None:
    m = TrajectoryMixture(
        torch.zeros(1, 1),
        torch.zeros(1, 1, 1, 2),
        4 * torch.eye(2)[None, None, None],
        torch.zeros(1, 2).double(),
    )
    density = m.log_density(torch.zeros(1, 1, 2, dtype=torch.float64))
    assert density.item() == pytest.approx(-math.log(2 * math.pi * 4))


def test_a_degenerate_mode_has_a_finite_density_that_falls_off() -> None:
    """Rank one, and no spread at all: both come from networks, for agents that stand or drive straight."""
    for covariance in (torch.tensor([[4.0, 2.0], [2.0, 1.0]]), torch.zeros(2, 2)):
        mixture = TrajectoryMixture(
            torch.zeros(1, 1),
            torch.zeros(1, 1, 1, 2),
            covariance.expand(1, 1, 1, 2, 2),
            torch.zeros(1, 2, dtype=torch.float64),
        )
        near, off = (mixture.log_density(torch.tensor([[[x, 0.0]]]).double()).item() for x in (0.0, 3.0))
        assert math.isfinite(near)
        assert math.isfinite(off)
        assert off < near - 10
