import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.distributions import Categorical, MixtureSameFamily, MultivariateNormal

from model.mixture import MergedModes, TrajectoryMixture, cholesky_2x2, merge_modes


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


def _fan(seed: int, agents: int = 3, modes: int = 8, steps: int = 6) -> TrajectoryMixture:
    """One of a few bundles of paths that leave the origin, so that some of its modes merge."""
    generator = torch.Generator().manual_seed(seed)
    bundles = 12 * torch.randn(agents, 3, 2, generator=generator, dtype=torch.float64)
    chosen = torch.randint(3, (agents, modes), generator=generator)
    time = torch.linspace(1 / steps, 1, steps, dtype=torch.float64)
    base = mixture(seed, agents, modes, steps)
    means = bundles.gather(1, chosen[..., None].expand(-1, -1, 2))[:, :, None] * time[:, None]
    return TrajectoryMixture(base.log_weights, means + 0.2 * base.means, base.covariances, base.origin)


def _near(kept: Tensor, other: Tensor, min_distance_m: float = 2.0, relative_distance: float = 0.2) -> bool:
    """Return whether a path [T, 2] is within the allowance of a kept one at every step."""
    allowed = (relative_distance * torch.linalg.vector_norm(kept, dim=-1)).clamp_min(min_distance_m)
    return bool((torch.linalg.vector_norm(kept - other, dim=-1) <= allowed).all())


def _leaders(weights: list[float], means: Tensor) -> dict[int, int]:
    """Return the mode that each of one agent's modes joins, by the documented rule."""
    leaders: dict[int, int] = {}
    for mode in sorted(range(len(weights)), key=lambda mode: -weights[mode]):
        kept = [leader for leader in leaders if leaders[leader] == leader]
        leaders[mode] = next((leader for leader in kept if _near(means[leader], means[mode])), mode)
    return leaders


def _members(merged: MergedModes, agent: int) -> dict[int, list[int]]:
    """The modes of each group of an agent, by the number of the group's heaviest."""
    ids, groups = merged.mode_ids[agent].tolist(), merged.groups[agent]
    return {ids[place]: (groups == place).nonzero()[:, 0].tolist() for place in range(merged.counts[agent])}


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_modes_join_the_heaviest_that_is_kept_and_near(seed: int) -> None:
    m = _fan(seed)
    merged = merge_modes(m)
    for agent in range(len(m)):
        leaders = _leaders(m.weights[agent].tolist(), m.means[agent])
        groups = _members(merged, agent)
        assert {mode: leader for leader, modes in groups.items() for mode in modes} == leaders
        assert list(groups) == sorted(set(leaders.values()))  # In the order of the model's own numbers
        for one in groups:
            heavier = [other for other in groups if m.weights[agent, other] > m.weights[agent, one]]
            assert not any(_near(m.means[agent, other], m.means[agent, one]) for other in heavier)


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_weights_add_up_and_second_moments_about_the_paths_are_kept(seed: int) -> None:
    m = _fan(seed)
    merged = merge_modes(m)
    torch.testing.assert_close(merged.mixture.weights.sum(1), torch.ones(3, dtype=torch.float64))
    for agent in range(len(m)):
        for place, (leader, modes) in enumerate(_members(merged, agent).items()):
            weights, path = m.weights[agent, modes], m.means[agent, leader]
            torch.testing.assert_close(merged.mixture.weights[agent, place], weights.sum())
            assert torch.equal(merged.mixture.means[agent, place], path)
            offset = m.means[agent, modes] - path
            moments = m.covariances[agent, modes] + offset[..., :, None] * offset[..., None, :]
            expected = torch.einsum("m,mtij->tij", weights / weights.sum(), moments)
            torch.testing.assert_close(merged.mixture.covariances[agent, place], expected)
            # About the group's own mean it is the members' covariance and the outer product of what the
            # kept path is off that mean
            group = TrajectoryMixture(
                weights.log()[None] - weights.sum().log(),
                m.means[agent, modes][None],
                m.covariances[agent, modes][None],
                torch.zeros(1, 2, dtype=torch.float64),
            )
            mean, covariance = (moment[0] for moment in group.moments())
            bias = mean - path
            torch.testing.assert_close(expected, covariance + bias[..., :, None] * bias[..., None, :])


@settings(max_examples=30, deadline=None)
@given(seeds, st.permutations(range(8)))
def test_the_order_of_modes_changes_nothing_but_their_order(seed: int, order: list[int]) -> None:
    m = _fan(seed)
    merged = merge_modes(m)
    turned = merge_modes(
        TrajectoryMixture(m.log_weights[:, order], m.means[:, order], m.covariances[:, order], m.origin)
    )
    for agent in range(len(m)):
        groups = {
            order[leader]: sorted(order[mode] for mode in modes)
            for leader, modes in _members(turned, agent).items()
        }
        assert groups == _members(merged, agent)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_merging_again_by_a_distance_alone_changes_nothing(seed: int) -> None:
    once = merge_modes(_fan(seed), relative_distance=0.0)
    again = merge_modes(once.mixture, relative_distance=0.0)
    most = int(once.counts.max())
    assert torch.equal(again.counts, once.counts)
    assert torch.equal(again.groups, torch.where(once.mode_ids < 0, -1, torch.arange(most)))
    assert torch.equal(again.mixture.log_weights, once.mixture.log_weights)
    assert torch.equal(again.mixture.means, once.mixture.means)
    assert torch.equal(again.mixture.covariances, once.mixture.covariances)


def test_merging_again_can_merge_more() -> None:
    """Two light modes together outweigh a third, and go far enough for it to be near them."""
    ends = torch.tensor([20.0, 24.2, 24.3], dtype=torch.float64)
    means = torch.stack([ends, torch.zeros(3, dtype=torch.float64)], dim=-1)[None, :, None]
    weights = torch.tensor([[0.4, 0.3, 0.3]], dtype=torch.float64)
    eye = torch.eye(2, dtype=torch.float64).expand(1, 3, 1, 2, 2)
    once = merge_modes(TrajectoryMixture(weights.log(), means, eye, torch.zeros(1, 2, dtype=torch.float64)))
    assert once.groups.tolist() == [[0, 1, 1]]
    assert merge_modes(once.mixture).mode_ids.tolist() == [[1]]


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_the_likeliest_merged_mode_is_the_group_of_greatest_weight(seed: int) -> None:
    m = _fan(seed)
    merged = merge_modes(m)
    best = merged.mixture.most_likely()
    for agent in range(len(m)):
        sums = {
            leader: float(m.weights[agent, modes].sum()) for leader, modes in _members(merged, agent).items()
        }
        assert merged.mode_ids[agent, best[agent]] == max(sums, key=sums.__getitem__)


def test_a_way_around_is_not_merged_though_it_ends_at_the_same_place() -> None:
    steps = torch.arange(1.0, 13.0)
    straight = torch.stack([2 * steps, torch.zeros(12)], dim=-1)
    around = straight + torch.stack([torch.zeros(12), 7 * torch.sin(math.pi * steps / 12)], dim=-1)
    near = straight + torch.tensor([0.0, 1.9])
    mixture = TrajectoryMixture(
        torch.tensor([[0.5, 0.3, 0.2]]).log(),
        torch.stack([straight, around, near])[None],
        torch.eye(2).expand(1, 3, 12, 2, 2),
        torch.zeros(1, 2, dtype=torch.float64),
    )
    merged = merge_modes(mixture)
    assert merged.groups.tolist() == [[0, 1, 0]]
    torch.testing.assert_close(merged.mixture.weights, torch.tensor([[0.7, 0.3]]))
    assert merge_modes(mixture, relative_distance=1.0).groups.tolist() == [[0, 0, 0]]
    assert merge_modes(mixture, 1.8, 0.0).groups.tolist() == [[0, 1, 2]]


def test_of_equal_weights_the_lower_number_is_kept() -> None:
    means = torch.tensor([9.0, 0.0, 1.0, 2.0])[None, :, None, None].expand(1, 4, 3, 2)
    eye = torch.eye(2).expand(1, 4, 3, 2, 2)
    merged = merge_modes(
        TrajectoryMixture(torch.full((1, 4), 0.25).log(), means, eye, torch.zeros(1, 2, dtype=torch.float64)),
        relative_distance=0.0,
    )
    # (2, 2) is 2.8 m from (0, 0), the kept mode 1, and 1.4 m from (1, 1), which is not kept
    assert merged.mode_ids.tolist() == [[0, 1, 3]]
    assert merged.groups.tolist() == [[0, 1, 1, 2]]


def test_modes_that_nothing_joins_keep_every_bit() -> None:
    m = mixture(2, modes=6, dtype=torch.float32)
    apart = TrajectoryMixture(
        m.log_weights, m.means + 1e3 * torch.arange(6)[:, None, None], m.covariances, m.origin + 1e6
    )
    for given_, relative in ((apart, 0.0), (mixture(3, modes=1, dtype=torch.float32), 0.2)):
        merged = merge_modes(given_, relative_distance=relative)
        for name in ("log_weights", "means", "covariances", "origin"):
            assert torch.equal(getattr(merged.mixture, name), getattr(given_, name))
        modes = given_.log_weights.shape[1]
        assert merged.mode_ids.tolist() == merged.groups.tolist() == 3 * [list(range(modes))]
        assert merged.counts.tolist() == 3 * [modes]


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(-1e6, 1e6))
def test_merging_hangs_neither_on_where_the_ground_frame_is_nor_on_the_rest_of_the_batch(
    seed: int, x: float
) -> None:
    m = _fan(seed)
    merged = merge_modes(m)
    moved = merge_modes(_moved(m, torch.tensor([x, -x], dtype=torch.float64)))
    assert torch.equal(moved.groups, merged.groups)
    assert torch.equal(moved.mixture.means, merged.mixture.means)
    for agent in range(len(m)):
        alone = merge_modes(m[agent : agent + 1])
        count = int(alone.counts)
        assert torch.equal(alone.groups[0], merged.groups[agent])
        assert torch.equal(alone.mixture.log_weights[0], merged.mixture.log_weights[agent, :count])
        assert torch.equal(alone.mixture.covariances[0], merged.mixture.covariances[agent, :count])


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_padded_modes_change_no_figure_of_a_mixture(seed: int) -> None:
    m = _fan(seed)
    merged = merge_modes(m)
    positions = m.origin[:, None] + _points(seed, 3, 6)
    for agent in range(len(m)):
        count = int(merged.counts[agent])
        padded, own = merged.mixture[agent : agent + 1], merged.mixture[agent : agent + 1]
        own = TrajectoryMixture(
            own.log_weights[:, :count], own.means[:, :count], own.covariances[:, :count], own.origin
        )
        assert padded.weights[0, count:].sum() == 0
        assert (merged.mode_ids[agent, count:] == -1).all()
        at = positions[agent : agent + 1]
        torch.testing.assert_close(padded.log_density(at), own.log_density(at), rtol=0, atol=1e-12)
        torch.testing.assert_close(padded.moments(), own.moments(), rtol=0, atol=1e-12)
        assert torch.equal(padded.sample(20, [seed]), own.sample(20, [seed]))
        assert padded.most_likely() == own.most_likely()


def test_a_negative_distance_is_refused() -> None:
    for distances in ((-1.0, 0.2), (2.0, -0.1)):
        with pytest.raises(ValueError, match="must not be negative"):
            merge_modes(mixture(), *distances)


def test_of_no_agents_nothing_is_merged() -> None:
    merged = merge_modes(mixture()[:0])
    assert len(merged.mixture) == len(merged.counts) == 0


def test_merging_a_forecast_that_is_no_number_leaves_it_so() -> None:
    mixture = TrajectoryMixture(
        torch.full((2, 3), math.nan),
        torch.full((2, 3, 4, 2), math.nan),
        torch.full((2, 3, 4, 2, 2), math.nan),
        torch.zeros(2, 2, dtype=torch.float64),
    )
    merged = merge_modes(mixture).mixture
    assert merged.log_weights.shape[1] >= 1
    assert merged.log_weights.isnan().all()
    assert merged.most_likely_trajectory().isnan().all()
