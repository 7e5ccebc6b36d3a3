"""Sets that cover trajectories."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from model.arrays import Float32s
from model.training import trajectory_set
from model.training.trajectory_set import choose_members, make_trajectory_set, summed_distances

EPSILON = 2.0
PATHS = arrays.arrays(
    np.float32,
    st.tuples(st.integers(1, 40), st.integers(1, 4), st.just(2)),
    elements=st.floats(-12, 12, width=16),
)


def greatest_distances(paths: Float32s) -> Float32s:
    """Return the maximum distances [N, N], m."""
    offset = paths[:, None] - paths[None]
    distances: Float32s = np.hypot(offset[..., 0], offset[..., 1]).max(axis=-1)
    return distances


def wandering(count: int, seed: int = 0) -> Float32s:
    """Return paths [count, 12, 2] that go on at some speed, more or less ahead."""
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0, 5, (count, 1, 1)) * np.array([1.0, 0.0]) + rng.normal(0, 0.3, (count, 12, 2))
    return np.cumsum(steps, axis=1).astype(np.float32)


@settings(deadline=None, max_examples=100)
@given(paths=PATHS)
def test_every_path_has_a_member_near_it(paths: Float32s) -> None:
    indices = choose_members(paths, EPSILON)
    distances = greatest_distances(paths)
    assert (distances[:, indices].min(axis=1) <= EPSILON + 1e-4).all()
    assert len(set(indices.tolist())) == len(indices)
    np.testing.assert_array_equal(indices, choose_members(paths.copy(), EPSILON))


@settings(deadline=None, max_examples=100)
@given(paths=PATHS)
def test_each_member_covers_as_much_as_any_path_could_then(paths: Float32s) -> None:
    within = greatest_distances(paths.astype(np.float64)) <= EPSILON
    uncovered = np.ones(len(paths), dtype=np.bool_)
    for index in choose_members(paths, EPSILON).tolist():
        gains = (within & uncovered).sum(axis=1)
        assert gains[index] == gains.max() > 0
        uncovered &= ~within[index]
    assert not uncovered.any()


@settings(deadline=None, max_examples=50)
@given(paths=PATHS)
def test_members_are_paths_and_the_variance_is_about_the_nearest(paths: Float32s) -> None:
    members, variance = make_trajectory_set(torch.from_numpy(paths), EPSILON)
    assert (members[:, None] == torch.from_numpy(paths)).all(dim=(2, 3)).any(dim=1).all()
    rest = torch.from_numpy(paths) - members[summed_distances(torch.from_numpy(paths), members).argmin(dim=1)]
    torch.testing.assert_close(variance, rest.square().mean(dim=0), rtol=1e-4, atol=1e-6)


def test_little_memory_gives_the_same_cover(monkeypatch: pytest.MonkeyPatch) -> None:
    paths = wandering(400)
    whole, parts = make_trajectory_set(torch.from_numpy(paths), EPSILON), choose_members(paths, EPSILON)
    monkeypatch.setattr(trajectory_set, "_PAIRS", 100)
    np.testing.assert_array_equal(choose_members(paths, EPSILON), parts)
    again = make_trajectory_set(torch.from_numpy(paths), EPSILON)
    assert torch.equal(whole.members, again.members)
    torch.testing.assert_close(whole.variance, again.variance)


def test_the_nearest_member_is_so_on_the_mean() -> None:
    members = torch.tensor([[[0.0, 0.0], [0.0, 0.0]], [[1.0, 0.0], [5.0, 0.0]]])
    paths = torch.tensor([[[1.0, 0.0], [2.0, 0.0]], [[1.0, 0.0], [3.5, 0.0]]])
    assert summed_distances(paths, members).argmin(dim=1).tolist() == [0, 1]


@pytest.mark.parametrize("paths", [np.zeros((0, 12, 2)), np.full((3, 12, 2), np.nan)])
def test_what_cannot_be_covered_is_refused(paths: Float32s) -> None:
    with pytest.raises(ValueError, match="finite numbers"):
        make_trajectory_set(torch.from_numpy(paths), EPSILON)


def test_a_cover_that_does_not_cover_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trajectory_set, "choose_members", lambda paths, epsilon: np.array([0]))
    with pytest.raises(ArithmeticError, match="away from the set"):
        make_trajectory_set(torch.from_numpy(wandering(50)), EPSILON)
