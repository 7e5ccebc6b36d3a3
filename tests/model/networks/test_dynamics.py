"""Dynamics against a step-by-step extended Kalman filter, and their invariances."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.networks.dynamics import STRAIGHT_BELOW, Controls, integrate_unicycle, integrate_velocity
from tests.model.networks.ekf import unicycle


def controls(seed: int, agents: int = 40, steps: int = 12, rate: float = 0.5) -> Controls:
    generator = torch.Generator().manual_seed(seed)

    def normal() -> torch.Tensor:
        return torch.randn(agents, steps, generator=generator)

    sx, sy, rho = 0.3 * normal().exp(), 0.5 * normal().exp(), torch.tanh(normal())
    return Controls(rate * normal(), 2 * normal(), sx**2, rho * sx * sy, sy**2)


@pytest.mark.parametrize("rate", [0.004, 0.01, 0.02, 0.3, 2.0, 8.0])
@pytest.mark.parametrize("seed", range(4))
def test_unicycle_is_the_extended_kalman_filter(seed: int, rate: float) -> None:
    c = controls(seed, rate=rate)
    generator = torch.Generator().manual_seed(seed + 100)
    heading, speed = 3 * torch.randn(40, generator=generator), 10 * torch.rand(40, generator=generator)
    mean, covariance = unicycle(c, heading, speed)
    ours = integrate_unicycle(c, heading, speed)
    torch.testing.assert_close(ours.mean.double(), mean, rtol=0, atol=2e-4)
    scale = covariance.abs().amax((-1, -2), keepdim=True)
    assert ((ours.covariance.double() - covariance).abs() / scale).max() < 2e-4


def test_no_turning_is_a_straight_line() -> None:
    zero = torch.zeros(1, 4)
    c = Controls(zero, torch.full((1, 4), 2.0), zero, zero, zero)
    mean = integrate_unicycle(c, torch.tensor([math.pi / 2]), torch.tensor([3.0])).mean[0]
    times = 0.5 * torch.arange(1, 5)
    torch.testing.assert_close(mean[:, 1], 3 * times + times**2)
    torch.testing.assert_close(mean[:, 0], torch.zeros(4), atol=1e-5, rtol=0)


def test_slow_turning_keeps_the_heading() -> None:
    zero = torch.zeros(1, 12)
    slow = Controls(torch.full((1, 12), 0.999 * STRAIGHT_BELOW), zero, zero + 1, zero, zero)
    positions = integrate_unicycle(slow, torch.zeros(1), torch.full((1,), 10.0))
    torch.testing.assert_close(positions.mean[0, :, 1], torch.zeros(12))
    torch.testing.assert_close(positions.covariance, torch.zeros(1, 12, 2, 2))
    fast = slow._replace(mean_0=torch.full((1, 12), 1.001 * STRAIGHT_BELOW))
    assert integrate_unicycle(fast, torch.zeros(1), torch.full((1,), 10.0)).mean[0, -1, 1] > 1


@settings(max_examples=30)
@given(st.integers(0, 1000), st.floats(-4, 4))
def test_turning_the_start_turns_the_forecast(seed: int, angle: float) -> None:
    c = controls(seed, agents=5)
    heading, speed = torch.zeros(5), torch.full((5,), 8.0)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    a, b = integrate_unicycle(c, heading, speed), integrate_unicycle(c, heading + angle, speed)
    torch.testing.assert_close(a.mean @ turn.T, b.mean, rtol=1e-4, atol=1e-3)
    scale = a.covariance.abs().amax((-1, -2), keepdim=True)
    turned = turn @ a.covariance @ turn.T
    assert ((turned - b.covariance).abs() / scale).max() < 1e-3


@given(st.integers(0, 1000))
def test_covariances_are_symmetric_and_positive(seed: int) -> None:
    positions = integrate_unicycle(controls(seed), torch.zeros(40), torch.full((40,), 5.0))
    covariance = positions.covariance.double()
    assert torch.equal(covariance, covariance.mT)
    scale = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert (torch.linalg.eigvalsh(covariance)[..., 0] > -1e-6 * scale).all()


def test_single_integrator_sums_velocities() -> None:
    c = controls(3)
    positions = integrate_velocity(c)
    torch.testing.assert_close(positions.mean[..., 0], 0.5 * c.mean_0.cumsum(-1))
    torch.testing.assert_close(positions.covariance[..., 1, 1], 0.25 * c.variance_1.cumsum(-1))
    torch.testing.assert_close(positions.covariance[..., 0, 1], 0.25 * c.covariance.cumsum(-1))
