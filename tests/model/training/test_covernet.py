"""The objective of CoverNet."""

import pytest
import torch

from model.networks.covernet import present_heading, turned
from model.training.config import Method
from model.training.covernet import CoverNetLearner
from model.training.learner import Batch
from model.training.objectives import LossWeights
from tests.model.training.fakes import MadeUpPairs, small_config

PAIRS = MadeUpPairs(12)


def terms(displacement: float) -> tuple[CoverNetLearner, dict[str, float]]:
    """Return a learner after one step, and the step's terms."""
    torch.manual_seed(0)
    learner = CoverNetLearner(small_config(Method.COVERNET), PAIRS.paths, torch.device("cpu"))
    learner.networks.eval()
    batch = Batch(*PAIRS.batch(torch.arange(12)))
    step = learner.step([batch], LossWeights(1.0, 5.0, displacement=displacement), rate=0.0)
    return learner, {name: term.item() for name, term in step.items()}


def test_the_published_objective_is_cross_entropy_alone() -> None:
    learner, said = terms(0.0)
    given, future = PAIRS.batch(torch.arange(12))
    path = turned(future, -present_heading(given))
    distance = (path[:, None] - learner.network.trajectory_set).norm(dim=-1).mean(-1)
    with torch.no_grad():
        log_shares = learner.network.scores(given).log_softmax(-1)
    expected = -log_shares[torch.arange(12), distance.argmin(1)].mean().item()
    assert said["loss"] == pytest.approx(expected, rel=1e-5)
    assert "displacement" not in said


def test_the_displacement_is_what_the_probabilities_expect() -> None:
    learner, said = terms(0.25)
    given, future = PAIRS.batch(torch.arange(12))
    path = turned(future, -present_heading(given))
    with torch.no_grad():
        shares = learner.network.scores(given).softmax(-1)
    expected = 0.0
    for agent in range(12):
        for share, member in zip(shares[agent].tolist(), learner.network.trajectory_set, strict=True):
            expected += share * (path[agent] - member).norm(dim=-1).sum().item() / 12
    assert said["displacement"] == pytest.approx(expected, rel=1e-4)
    _, without = terms(0.0)
    assert said["loss"] == pytest.approx(without["loss"] + 0.25 * expected, rel=1e-4)
