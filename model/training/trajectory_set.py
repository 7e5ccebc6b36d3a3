"""A set of trajectories that covers all that were driven (CoverNet, Phan-Minh et al. 2020, section 3.2).

A set covers trajectories within ε when each of them has a member that is nowhere farther away than ε, in the
agents' own frames. The smallest such set is NP-hard to find; as in the paper, the member that covers most of
what is not yet covered comes next, until all is.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from model.arrays import Bools, Float32s, Ints

_PAIRS = 1 << 20
"""Distances at once: bounds the memory, whatever the number of trajectories."""
_ROUNDING = 1e-4
"""m."""


class Cover(NamedTuple):
    """A cover of N trajectories within ε, and how they lie about it."""

    members: Tensor
    """[M, T, 2] float32, m, x ahead and y to the left of the agent now; each is one of the trajectories.
    Those that cover most come first."""
    variance: Tensor
    """[T, 2] float32, m²: mean square of what the trajectories differ by, ahead and to the left, from their
    nearest members (by ``summed_distances``)."""


def make_cover(paths: Tensor, epsilon: float) -> Cover:
    """A cover; the same whenever the trajectories are.

    Args:
        paths: [N, T, 2], N ≥ 1, m, in the agents' own frames.
        epsilon: m, of the greatest distance at any step.

    Raises:
        ValueError: there are no paths, or some are not finite.
        ArithmeticError: the cover does not cover them, which would be a fault in here.
    """
    paths = paths.float().cpu()
    members = paths[torch.from_numpy(cover_indices(paths.numpy(), epsilon))]
    worst, squares = 0.0, torch.zeros(paths.shape[1:], dtype=torch.float64)
    for some in paths.split(max(1, _PAIRS // len(members))):
        greatest, total = torch.zeros(len(some), len(members)), torch.zeros(len(some), len(members))
        for distance in _step_distances(some, members):
            torch.maximum(greatest, distance, out=greatest)
            total += distance
        worst = max(worst, greatest.amin(dim=1).amax().item())
        squares += (some - members[total.argmin(dim=1)]).double().square().sum(dim=0)
    if worst > epsilon + _ROUNDING:
        raise ArithmeticError(f"a trajectory is {worst:.4f} m away from its cover within {epsilon:g} m")
    return Cover(members, (squares / len(paths)).float())


def cover_indices(paths: Float32s, epsilon: float) -> Ints:
    """Which of the trajectories are members of their cover: [M], in the order in which they were chosen.

    Args:
        paths: [N, T, 2], N ≥ 1, m.
        epsilon: m.

    Raises:
        ValueError: there are no paths, or some are not finite.
    """
    if not len(paths) or not np.isfinite(paths).all():
        raise ValueError("a cover needs trajectories, of finite numbers")
    # By where they end ahead, so that those near one are side by side
    order = np.argsort(paths[:, -1, 0], kind="stable")
    ordered = np.ascontiguousarray(paths[order])
    count = len(paths)
    gain = np.zeros(count, dtype=np.int64)  # how many uncovered ones each would cover
    uncovered = np.ones(count, dtype=np.bool_)
    for first in range(count):
        if uncovered[first]:
            _take(ordered, first, epsilon, uncovered, gain, sign=1)
    uncovered[:] = True
    members = []
    left = count
    while left:
        best = int(gain.argmax())
        left -= _take(ordered, best, epsilon, uncovered, gain, sign=-1)
        members.append(best)
    chosen: Ints = order[members]
    return chosen


def _take(paths: Float32s, leader: int, epsilon: float, uncovered: Bools, gain: Ints, sign: int) -> int:
    """Covers what is within ε of the leader; how many that are.

    For each of them the gain of all that are within ε of it changes by the sign. No list of neighbours is
    kept, which could be as long as the square of the number of paths: what is near a covered path is near
    the leader, too, and so found again at little cost.

    Args:
        paths: [N, T, 2], ascending in x of the last step.
        leader: index of one.
        epsilon: m.
        uncovered: [N], changed.
        gain: [N], changed.
        sign: ±1.
    """
    own, ends = paths[leader : leader + 1], paths[:, -1, 0]
    # A little more than twice: the triangle inequality does not hold to the last bit
    reach = 2 * epsilon + _ROUNDING
    low, high = np.searchsorted(ends, [ends[leader] - reach, ends[leader] + reach])
    near = low + np.flatnonzero(_within(own, paths[low:high], reach)[0])
    covered = near[uncovered[near] & _within(own, paths[near], epsilon)[0]]
    neighbors = paths[near]
    for some in np.array_split(covered, 1 + len(covered) * len(near) // _PAIRS):
        gain[near] += sign * _within(paths[some], neighbors, epsilon).sum(axis=0)
    uncovered[covered] = False
    return len(covered)


def _within(ones: Float32s, others: Float32s, reach: float) -> Bools:
    """[n, m], whether paths [n, T, 2] and [m, T, 2] are nowhere farther from each other than that, m."""
    inside = np.ones((len(ones), len(others)), dtype=np.bool_)
    for step in range(ones.shape[1] - 1, -1, -1):
        x = ones[:, step, 0, None] - others[None, :, step, 0]
        y = ones[:, step, 1, None] - others[None, :, step, 1]
        inside &= x * x + y * y <= reach * reach
    return inside


def summed_distances(paths: Tensor, members: Tensor) -> Tensor:
    """Distances of every path from every member, summed over the steps: [N, M], m.

    Args:
        paths: [N, T, 2], m, in the agents' own frames.
        members: [M, T, 2], on the same device.
    """
    total = torch.zeros(len(paths), len(members), device=paths.device)
    for distance in _step_distances(paths, members):
        total += distance
    return total


def _step_distances(paths: Tensor, members: Tensor) -> Iterator[Tensor]:
    """Distances [N, M] at each step, m; without matrix products, which would lose the small ones."""
    for step in range(paths.shape[1]):
        x = paths[:, step, 0, None] - members[None, :, step, 0]
        y = paths[:, step, 1, None] - members[None, :, step, 1]
        yield x.square_().addcmul_(y, y).sqrt_()
