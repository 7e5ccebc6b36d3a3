"""CoverNet's fixed set of trajectories, which covers those of the training set (Phan-Minh et al. 2020, 3.2).

A set covers trajectories within ε if each of them has a member that is at most ε away at every step, in the
agents' own frames. Finding the smallest such set is NP-hard. As in the paper, a greedy search takes the
trajectory that covers most of those not yet covered, until all are.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from model.arrays import Bools, Float32s, Ints

_PAIRS = 1 << 20
"""Distances computed at once; bounds the memory, whatever the number of trajectories."""
_ROUNDING = 1e-4
"""m."""


class TrajectorySet(NamedTuple):
    """A set that covers N trajectories within ε, and the spread of these about it."""

    members: Tensor
    """[M, T, 2] float32, m, x ahead and y to the left of the agent now; each is one of the trajectories.
    Members that cover most come first."""
    variance: Tensor
    """[T, 2] float32, m², mean squared difference, ahead and to the left, between the trajectories and their
    nearest members (by ``summed_distances``)."""


def make_trajectory_set(paths: Tensor, epsilon: float) -> TrajectorySet:
    """Return a set that covers trajectories; it is a deterministic function of them.

    Args:
        paths: [N, T, 2], N ≥ 1, m, in the agents' own frames.
        epsilon: maximum distance at any step, m.

    Raises:
        ValueError: there are no paths, or some are not finite.
        ArithmeticError: the set does not cover the paths (a bug in this module).
    """
    paths = paths.float().cpu()
    members = paths[torch.from_numpy(choose_members(paths.numpy(), epsilon))]
    worst, squares = 0.0, torch.zeros(paths.shape[1:], dtype=torch.float64)
    for some in paths.split(max(1, _PAIRS // len(members))):
        greatest, total = torch.zeros(len(some), len(members)), torch.zeros(len(some), len(members))
        for distance in _step_distances(some, members):
            torch.maximum(greatest, distance, out=greatest)
            total += distance
        worst = max(worst, greatest.amin(dim=1).amax().item())
        squares += (some - members[total.argmin(dim=1)]).double().square().sum(dim=0)
    if worst > epsilon + _ROUNDING:
        raise ArithmeticError(
            f"a trajectory is {worst:.4f} m away from the set that covers within {epsilon:g} m"
        )
    return TrajectorySet(members, (squares / len(paths)).float())


def choose_members(paths: Float32s, epsilon: float) -> Ints:
    """Return the indices of the trajectories that are members: [M], in the order in which they were chosen.

    Args:
        paths: [N, T, 2], N ≥ 1, m.
        epsilon: maximum distance at any step, m.

    Raises:
        ValueError: there are no paths, or some are not finite.
    """
    if not len(paths) or not np.isfinite(paths).all():
        raise ValueError("a set of trajectories has to be made of trajectories of finite numbers")
    # Sorted by the last x, so that the neighbours of one are a slice
    order = np.argsort(paths[:, -1, 0], kind="stable")
    ordered = np.ascontiguousarray(paths[order])
    count = len(paths)
    gain = np.zeros(count, dtype=np.int64)  # how many uncovered paths each would cover
    uncovered = np.ones(count, dtype=np.bool_)
    for first in range(count):
        if uncovered[first]:
            _cover(ordered, first, epsilon, uncovered, gain, sign=1)
    uncovered[:] = True
    members = []
    left = count
    while left:
        best = int(gain.argmax())
        left -= _cover(ordered, best, epsilon, uncovered, gain, sign=-1)
        members.append(best)
    chosen: Ints = order[members]
    return chosen


def _cover(paths: Float32s, leader: int, epsilon: float, uncovered: Bools, gain: Ints, sign: int) -> int:
    """Mark what is within ε of a leader as covered; return the number of newly covered paths.

    For each of them the gain of all paths within ε of it changes by the sign. Lists of neighbours are not
    kept, as they could be as long as the square of the number of paths: what is near a covered path is also
    near the leader, and so cheap to find again.

    Args:
        paths: [N, T, 2], ascending in x of the last step.
        leader: index of the leader.
        epsilon: maximum distance at any step, m.
        uncovered: [N], changed in place.
        gain: [N], changed in place.
        sign: ±1.
    """
    own, ends = paths[leader : leader + 1], paths[:, -1, 0]
    # A little more than 2 ε, as rounding breaks the triangle inequality
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
    """Return which paths [n, T, 2] and [m, T, 2] are within a reach (m) at all steps: [n, m]."""
    inside = np.ones((len(ones), len(others)), dtype=np.bool_)
    for step in range(ones.shape[1] - 1, -1, -1):
        x = ones[:, step, 0, None] - others[None, :, step, 0]
        y = ones[:, step, 1, None] - others[None, :, step, 1]
        inside &= x * x + y * y <= reach * reach
    return inside


def summed_distances(paths: Tensor, members: Tensor) -> Tensor:
    """Return the distances of every path from every member, summed over the steps: [N, M], m.

    Args:
        paths: [N, T, 2], m, in the agents' own frames.
        members: [M, T, 2], on the same device.
    """
    total = torch.zeros(len(paths), len(members), device=paths.device)
    for distance in _step_distances(paths, members):
        total += distance
    return total


def _step_distances(paths: Tensor, members: Tensor) -> Iterator[Tensor]:
    """Yield the distances [N, M] at each step, m; matrix products would lose the small ones to rounding."""
    for step in range(paths.shape[1]):
        x = paths[:, step, 0, None] - members[None, :, step, 0]
        y = paths[:, step, 1, None] - members[None, :, step, 1]
        yield x.square_().addcmul_(y, y).sqrt_()
