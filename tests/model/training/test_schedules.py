"""Schedules."""

import math

import pytest

from model.training.schedules import KL_SHARE, Z_LOGIT_CLIP, Sigmoid, cooldown, decayed


def test_a_sigmoid_is_halfway_at_its_center_and_goes_from_start_to_end() -> None:
    curve = Sigmoid(2.0, 10.0, center=100, width=10)
    assert curve(100) == pytest.approx(6.0)
    assert curve(0) == pytest.approx(2.0, abs=1e-3)
    assert curve(1000) == pytest.approx(10.0)
    assert curve(110) == pytest.approx(2 + 8 / (1 + math.exp(-1)))


def test_the_released_schedules() -> None:
    assert KL_SHARE(400) == pytest.approx(0.5)
    assert KL_SHARE(0) < 0.02
    assert Z_LOGIT_CLIP(300) == pytest.approx(2.525)
    assert Z_LOGIT_CLIP(0) < 0.1
    assert Z_LOGIT_CLIP(3000) == pytest.approx(5.0)


def test_the_learning_rate_decays_to_a_floor() -> None:
    assert decayed(0.003, 0) == 0.003
    assert decayed(0.003, 1) == pytest.approx(0.003 * 0.9999)
    assert decayed(0.003, 10**6) == 1e-5


def test_the_learning_rate_cools_down_at_the_end() -> None:
    assert [cooldown(step, 10, 4) for step in (0, 6, 7, 9, 10, 11)] == [1, 1, 0.75, 0.25, 0, 0]
    assert cooldown(10, 10, 0) == 1
