"""Those who stay, and those who stand in the way."""

import pytest
import torch

from loadtest.forward import features_in_agent_frame
from model.data.holdups import ASIDE_M, BLOCKED, GAP_M, block, hold
from model.features.agent_features import NEIGHBOR_POSITION_SCALE, NEIGHBOR_REACH_M, NEIGHBORS
from model.forecaster import Features

COUNT = 4000


def test_most_of_those_who_leave_stay_and_nobody_else_changes() -> None:
    future = torch.randn(COUNT, 12, 2)
    leaving = torch.arange(COUNT) % 2 == 0
    held = hold(future, leaving, 0.1, torch.Generator().manual_seed(0))
    changed = (held != future).any(dim=2).any(dim=1)
    assert not changed[~leaving].any()
    assert (held[changed] == 0).all()
    assert changed[leaving].float().mean().item() == pytest.approx(0.9, abs=0.03)
    again = hold(future, leaving, 0.1, torch.Generator().manual_seed(0))
    assert torch.equal(held, again)


@pytest.mark.parametrize(("share", "stay"), [(0.0, True), (1.0, False)])
def test_all_stay_or_all_leave(share: float, stay: bool) -> None:
    future = torch.ones(50, 12, 2)
    held = hold(future, torch.ones(50, dtype=torch.bool), share, torch.Generator().manual_seed(0))
    assert (held == 0).all().item() is stay


def alone(count: int) -> Features:
    """Features of agents with no neighbour but the first one."""
    features = features_in_agent_frame(count)
    features["neighbors"][:, 1:] = 0.0
    return features


def test_some_get_a_vehicle_that_stands_beyond_where_they_went() -> None:
    torch.manual_seed(0)
    features = alone(COUNT)
    turn = torch.linspace(-1.0, 1.0, COUNT)
    direction = torch.stack([turn.cos(), turn.sin()], dim=-1)
    future = direction[:, None] * 1.5 * torch.arange(1, 13)[:, None]
    before = features["neighbors"].clone()
    neighbors = block(features, future)["neighbors"]
    assert torch.equal(features["neighbors"], before)
    new = neighbors[:, 1]
    there = new[:, -1] > 0
    assert there.float().mean().item() == pytest.approx(BLOCKED, abs=0.02)
    assert torch.equal(neighbors[:, 0], before[:, 0])
    assert not neighbors[:, 2:].any()
    assert not new[~there].any()
    beyond = NEIGHBOR_POSITION_SCALE * new[there, :2] - future[there, -1]
    along = (beyond * direction[there]).sum(dim=1)
    aside = beyond[:, 1] * direction[there, 0] - beyond[:, 0] * direction[there, 1]
    assert (along >= GAP_M[0] - 1e-3).all()
    assert (along <= GAP_M[1] + 1e-3).all()
    assert aside.std().item() == pytest.approx(ASIDE_M, rel=0.2)
    torch.testing.assert_close(new[there, 2:4], direction[there])
    assert (new[there, 4:8] == 0).all()  # it stands


def test_nobody_is_put_beyond_the_reach_or_where_all_places_are_taken() -> None:
    torch.manual_seed(1)
    far = torch.zeros(COUNT, 12, 2)
    far[:, :, 0] = 20.0 * torch.arange(1, 13)
    assert not block(alone(COUNT), far)["neighbors"][:, 1:].any()
    full = features_in_agent_frame(COUNT)
    assert full["neighbors"].shape[1] == NEIGHBORS
    assert torch.equal(block(full, torch.zeros(COUNT, 12, 2))["neighbors"], full["neighbors"])


def test_who_stands_is_blocked_ahead() -> None:
    torch.manual_seed(2)
    new = block(alone(COUNT), torch.zeros(COUNT, 12, 2))["neighbors"][:, 1]
    place = NEIGHBOR_POSITION_SCALE * new[new[:, -1] > 0, :2]
    assert (place[:, 0] >= GAP_M[0] - 1e-3).all()
    assert (place.norm(dim=1) < NEIGHBOR_REACH_M).all()
    assert (place[:, 1].abs() < 6 * ASIDE_M).all()
