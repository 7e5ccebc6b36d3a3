"""Input and output of HalentNet's discriminator."""

import pytest
import torch

from model.training.discriminator import BUMP_PEAK, Discriminator, draw


def test_a_position_is_a_bump_where_the_patch_has_it() -> None:
    # 6 m ahead: row 10 + 18; 3 m to the left: column 50 + 9 (REFERENCE: 10 px behind, 50 px aside, 3 px/m)
    marks = draw(torch.tensor([[[6.0, 3.0], [0.0, 0.0]]]))
    assert marks.shape == (1, 2, 100, 100)
    assert divmod(int(marks[0, 0].argmax()), 100) == (28, 59)
    assert divmod(int(marks[0, 1].argmax()), 100) == (10, 50)
    assert marks[0, 0, 28, 59].item() == pytest.approx(BUMP_PEAK)
    # one standard deviation, 5 px, away
    assert marks[0, 0, 33, 59].item() == pytest.approx(BUMP_PEAK * 0.60653, rel=1e-4)


def test_what_lies_outside_the_patch_leaves_no_mark() -> None:
    assert draw(torch.tensor([[[300.0, 0.0]]])).max() < 1e-6


def test_a_mark_moves_with_its_position() -> None:
    path = torch.tensor([[[5.2, -1.1]]], requires_grad=True)
    marks = draw(path)
    rows = torch.arange(100.0)
    (gradient,) = torch.autograd.grad((marks[0, 0].sum(1) * rows).sum() / marks.detach().sum(), path)
    # The centre of mass moves by 3 px a metre ahead, and not by the side
    assert gradient[0, 0, 0].item() == pytest.approx(3.0, rel=1e-3)
    assert gradient[0, 0, 1].item() == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_a_verdict_has_a_number_for_real_and_one_a_category(dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    judge = Discriminator(steps=12, modes=5, dtype=dtype)
    paths = torch.randn(3, 12, 2)
    patches = torch.rand(3, 3, 100, 100) * 2 - 1
    verdict = judge(patches, paths)
    assert verdict.real.shape == (3,)
    assert verdict.latent_logits.shape == (3, 5)
    assert verdict.real.dtype == torch.float32
    assert not torch.allclose(verdict.real, judge(None, paths).real)


def test_without_a_map_its_place_is_zeros() -> None:
    judge = Discriminator(steps=12, modes=5).eval()
    paths = torch.randn(3, 12, 2)
    assert torch.equal(judge(None, paths).real, judge(torch.zeros(3, 3, 100, 100), paths).real)
