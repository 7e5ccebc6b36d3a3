"""Dynamics that turn control distributions into position distributions.

Trajectron++, section 4.2: means go through the dynamics, covariances through its Jacobians (as in an
extended Kalman filter). Every state except the position is a running sum of controls, and the position is a
running sum of increments that depend on those states. So all steps are computed at once. The 2 × 2 algebra is
written out, because products of tiny matrices are slow while operations on whole tensors are fast.
"""

from collections.abc import Sequence
from math import factorial
from typing import NamedTuple

import torch
from torch import Tensor

from model.scenes.scene import STEP_SECONDS

STRAIGHT_BELOW = 0.01
"""rad/s; a slower turn counts as none: the heading stays and its uncertainty does not grow, as in the
released Trajectron++, whose weights are trained with it."""


class Controls(NamedTuple):
    """A Gaussian over two controls at each step: [..., T] each."""

    mean_0: Tensor
    """Heading rate (rad/s), or velocity along x (m/s)."""
    mean_1: Tensor
    """Acceleration (m/s²), or velocity along y (m/s)."""
    variance_0: Tensor
    covariance: Tensor
    variance_1: Tensor


class Positions(NamedTuple):
    """Gaussians over positions relative to now: means [..., T, 2], m, covariances [..., T, 2, 2], m²."""

    mean: Tensor
    covariance: Tensor


def integrate_velocity(controls: Controls) -> Positions:
    """Integrate velocities into positions (single integrator, for pedestrians)."""
    dt = STEP_SECONDS
    x, y, xx, xy, yy = _running_sums(torch.stack(controls), inclusive=True)
    return _positions(dt * x, dt * y, dt**2 * xx, dt**2 * xy, dt**2 * yy)


def integrate_unicycle(controls: Controls, heading: Tensor, speed: Tensor) -> Positions:
    """Integrate heading rates and accelerations into positions (unicycle, for vehicles).

    Args:
        controls: heading rate and acceleration, [..., T].
        heading: [...] rad, now.
        speed: [...] m/s, now.
    """
    dt = STEP_SECONDS
    straight = controls.mean_0.abs() <= STRAIGHT_BELOW
    w, ww, wa = (c.masked_fill(straight, 0.0) for c in (controls[0], controls[2], controls[3]))
    a, aa = controls.mean_1, controls.variance_1

    # Before each step: heading and speed, and their covariance Q
    before = dt * _running_sums(torch.stack([w, a, dt * ww, dt * wa, dt * aa]), inclusive=False)
    phi, v = heading[..., None] + before[0], speed[..., None] + before[1]
    q_hh, q_hv, q_vv = before[2:]
    s = _unicycle_step(phi, v, w, a)

    # With p the position, q = (heading, speed), u the control with covariance U, A = ∂p'/∂q, B = ∂p'/∂u:
    #   Σqq' = Σqq + dt² U
    #   Σpq' = Σpq + A Σqq + dt B U
    #   Σpp' = Σpp + A Σqp + Σpq Aᵀ + A Σqq Aᵀ + B U Bᵀ
    # The derivative by the heading is the displacement turned by a right angle.
    x_h, y_h = -s.dy, s.dx
    aq = (
        x_h * q_hh + s.x_v * q_hv,
        x_h * q_hv + s.x_v * q_vv,
        y_h * q_hh + s.y_v * q_hv,
        y_h * q_hv + s.y_v * q_vv,
    )
    bu = (s.x_w * ww + s.x_a * wa, s.x_w * wa + s.x_a * aa, s.y_w * ww + s.y_a * wa, s.y_w * wa + s.y_a * aa)
    increments = torch.stack([one + dt * two for one, two in zip(aq, bu, strict=True)])
    pq = _running_sums(increments, inclusive=False)
    # Σpq Aᵀ + half of A Σqq Aᵀ is added together with its transpose
    m_xh, m_xv, m_yh, m_yv = (one + 0.5 * two for one, two in zip(pq, aq, strict=True))
    xx = 2 * (m_xh * x_h + m_xv * s.x_v) + bu[0] * s.x_w + bu[1] * s.x_a
    yy = 2 * (m_yh * y_h + m_yv * s.y_v) + bu[2] * s.y_w + bu[3] * s.y_a
    xy = m_xh * y_h + m_xv * s.y_v + m_yh * x_h + m_yv * s.x_v + bu[0] * s.y_w + bu[1] * s.y_a
    return _positions(*_running_sums(torch.stack([s.dx, s.dy, xx, xy, yy]), inclusive=True))


def _running_sums(values: Tensor, inclusive: bool) -> Tensor:
    """Sum over the last axis up to each step (inclusive) or up to the step before.

    A product with a triangular matrix: torch.cumsum is several times slower on rows as short as these.
    """
    steps = values.shape[-1]
    triangle = torch.ones(steps, steps, dtype=values.dtype, device=values.device)
    return values @ triangle.triu(0 if inclusive else 1)


def _positions(x: Tensor, y: Tensor, xx: Tensor, xy: Tensor, yy: Tensor) -> Positions:
    covariance = torch.stack([xx, xy, xy, yy], dim=-1).unflatten(-1, (2, 2))
    return Positions(torch.stack([x, y], dim=-1), covariance)


class _UnicycleStep(NamedTuple):
    """Displacement over one step, and its derivatives by speed, heading rate and acceleration."""

    dx: Tensor
    dy: Tensor
    x_v: Tensor
    y_v: Tensor
    x_w: Tensor
    y_w: Tensor
    x_a: Tensor
    y_a: Tensor


def _unicycle_step(phi: Tensor, v: Tensor, w: Tensor, a: Tensor) -> _UnicycleStep:
    """Return the exact integral of (v + at)·(cos, sin)(φ + wt) over one step, and its derivatives."""
    dt = STEP_SECONDS
    cos, sin = phi.cos(), phi.sin()
    c0, c1, c2, s0, s1, s2 = _moments(w * dt)
    along = [dt * (cos * c0 - sin * s0), dt**2 * (cos * c1 - sin * s1), dt**3 * (cos * c2 - sin * s2)]
    aside = [dt * (sin * c0 + cos * s0), dt**2 * (sin * c1 + cos * s1), dt**3 * (sin * c2 + cos * s2)]
    return _UnicycleStep(
        dx=v * along[0] + a * along[1],
        dy=v * aside[0] + a * aside[1],
        x_v=along[0],
        y_v=aside[0],
        x_w=-v * aside[1] - a * aside[2],
        y_w=v * along[1] + a * along[2],
        x_a=along[1],
        y_a=aside[1],
    )


def _moments(theta: Tensor) -> tuple[Tensor, ...]:
    """Return ∫₀¹ uⁿ cos(θu) du for n = 0, 1, 2, then ∫₀¹ uⁿ sin(θu) du likewise.

    Small angles use the power series: the closed forms divide by θ³, and their rounding in float32 would
    make covariances wrong by tens of percent in slow turns, which are most of driving.
    """
    small = theta.abs() < 1
    near = torch.where(small, theta, 0.0)
    square = near.square()
    series = [_polynomial(square, coefficients) for coefficients in _COSINE_SERIES]
    series += [near * _polynomial(square, coefficients) for coefficients in _SINE_SERIES]
    if bool(small.all()):
        return tuple(series)
    far = torch.where(small, 1.0, theta)
    cos, sin = far.cos(), far.sin()
    c0, s0 = sin / far, (1 - cos) / far
    c1, s1 = (sin - s0) / far, (c0 - cos) / far
    c2, s2 = (sin - 2 * s1) / far, (2 * c1 - cos) / far
    closed = (c0, c1, c2, s0, s1, s2)
    return tuple(torch.where(small, x, y) for x, y in zip(series, closed, strict=True))


_TERMS = range(6)  # the first omitted term is below 2e-10 for |θ| < 1
_COSINE_SERIES = [[(-1) ** k / (factorial(2 * k) * (2 * k + n + 1)) for k in _TERMS] for n in range(3)]
_SINE_SERIES = [[(-1) ** k / (factorial(2 * k + 1) * (2 * k + n + 2)) for k in _TERMS] for n in range(3)]


def _polynomial(x: Tensor, coefficients: Sequence[float]) -> Tensor:
    """Return Σ coefficients[k] · xᵏ."""
    result = torch.full_like(x, coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = result * x + coefficient
    return result
