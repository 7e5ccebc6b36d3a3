"""The parts that all baselines share."""

import numpy as np
import pytest
import torch

from model.baselines.kalman import Kalman
from model.baselines.unimodal import step_times, unimodal
from tests.model.made_scenes import present, tracks


def test_agents_that_are_not_observed_now_are_refused_by_index() -> None:
    states = tracks([[(0.0, 0.0), (1.0, 0.0)], [(5.0, 5.0)]], frames=2).states
    states.require_observed(np.array([0, 1]))
    states.first[1] = 2
    states.require_observed(np.array([0]))
    with pytest.raises(ValueError, match=r"agents \[1\] are not observed now"):
        states.require_observed(np.array([0, 1]))


def test_steps_are_half_a_second_apart() -> None:
    assert step_times(Kalman.info, 3).tolist() == [0.5, 1.0, 1.5]
    assert step_times(Kalman.info, None)[-1] == 6.0
    for steps in (0, 13):
        with pytest.raises(ValueError, match=f"1 … 12, not {steps}"):
            step_times(Kalman.info, steps)


def test_one_mode_has_the_whole_weight() -> None:
    origin = torch.from_numpy(present(position=(1e6, 2e6)).states.position[:, -1])
    means, covariances = torch.ones(1, 4, 2).double(), torch.eye(2).expand(1, 4, 2, 2).double()
    mixture = unimodal(means, covariances, origin)
    assert mixture.weights.tolist() == [[1.0]]
    assert mixture.means.shape == (1, 1, 4, 2)
    assert mixture.means.dtype == mixture.covariances.dtype == torch.float32
    assert mixture.world_means[0, 0, 0].tolist() == [1e6 + 1, 2e6 + 1]
