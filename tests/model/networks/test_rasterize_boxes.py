"""Boxes in the picture."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from model.features.neighbor_boxes import BOX_SIZE, BOXES
from model.networks.rasterize_boxes import rasterize_boxes

SIZES = list(BOX_SIZE.values())


def picture(*boxes: tuple[float, float, float, float, float]) -> Tensor:
    """[100, 100], from 0 to 1."""
    padded = torch.zeros(1, BOXES, 5)
    for row, box in enumerate(boxes):
        padded[0, row] = torch.tensor(box)
    return (rasterize_boxes(padded)[0] + 1) / 2


def test_nobody_is_an_empty_picture() -> None:
    assert not picture().any()
    assert rasterize_boxes(torch.zeros(0, BOXES, 5)).shape == (0, 100, 100)


@settings(deadline=None, max_examples=60)
@given(
    ahead=st.floats(2, 24),
    left=st.floats(-12, 12),
    turn=st.floats(-3.2, 3.2),
    size=st.sampled_from(SIZES),
)
def test_a_box_has_its_area_and_its_middle(
    ahead: float, left: float, turn: float, size: tuple[float, float]
) -> None:
    drawn = picture((ahead, left, turn, *size))
    total = drawn.sum().item()
    # Only the pixels that an edge passes through can be off, each by a little
    assert total == pytest.approx(9 * math.prod(size), abs=0.1 * 3 * 2 * sum(size))
    index = torch.arange(100.0)
    row, column = (drawn.sum(1) @ index).item() / total, (drawn.sum(0) @ index).item() / total
    assert row == pytest.approx(10 + 3 * ahead, abs=0.1)
    assert column == pytest.approx(50 + 3 * left, abs=0.1)


def test_the_pixels_of_a_straight_and_of_a_turned_box() -> None:
    straight = picture((10.0, 0.0, 0.0, 4.5, 2.0))  # rows 40 ± 6.75, columns 50 ± 3
    assert (straight[34:47, 48:53] == 1).all()
    assert straight[33, 50] == pytest.approx(0.25)
    assert straight[40, 47] == pytest.approx(0.5)
    assert not straight[:33].any()
    assert not straight[:, :47].any()
    turned = picture((10.0, 0.0, math.pi / 2, 4.5, 2.0))
    torch.testing.assert_close(turned[40 - 20 : 41 + 20, 30:71], straight[20:61, 30:71].T, atol=1e-5, rtol=0)


def test_what_reaches_over_the_edge_is_cut_and_overlaps_are_full() -> None:
    for box in ((-3.3, 0.0), (29.9, 0.0), (5.0, 16.5), (5.0, -16.7), (-5.5, 0.0), (32.0, 18.0)):
        drawn = picture((*box, 0.3, 4.5, 2.0))
        assert 0 <= drawn.sum() < 81
    twice = picture((10.0, 0.0, 0.0, 4.5, 2.0), (10.0, 0.0, 0.0, 4.5, 2.0))
    assert twice.max() == 1
    assert twice[33, 50] == pytest.approx(0.5)


def test_each_agent_has_its_own_picture() -> None:
    boxes = torch.zeros(2, BOXES, 5)
    boxes[0, 0] = torch.tensor([10.0, 0.0, 0.0, 4.5, 2.0])
    boxes[1, 0] = torch.tensor([20.0, 5.0, 1.0, 0.8, 0.8])
    both = rasterize_boxes(boxes)
    for row in range(2):
        torch.testing.assert_close(both[row], rasterize_boxes(boxes[row : row + 1])[0])
