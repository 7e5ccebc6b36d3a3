"""The order of an epoch."""

import torch

from model.training.sampling import CURVED_RADIANS, epoch_order, random_turns


def test_straight_paths_come_once_curved_ones_several_times() -> None:
    turned = torch.tensor([0.0, CURVED_RADIANS + 0.01, -2.0, 0.1])
    counts = torch.bincount(epoch_order(turned, 3, seed=0, epoch=0))
    assert counts.tolist() == [1, 3, 3, 1]


def test_an_epochs_order_hangs_on_seed_and_number_alone() -> None:
    turned = torch.zeros(100)
    first = epoch_order(turned, 2, seed=1, epoch=4)
    assert torch.equal(first, epoch_order(turned, 2, seed=1, epoch=4))
    assert not torch.equal(first, epoch_order(turned, 2, seed=1, epoch=5))
    assert not torch.equal(first, epoch_order(turned, 2, seed=2, epoch=4))


def test_turns_are_multiples_of_15_degrees() -> None:
    turns = random_turns(1000, torch.Generator().manual_seed(0))
    steps = turns / (torch.pi / 12)
    torch.testing.assert_close(steps, steps.round())
    assert len(steps.round().unique()) == 24
