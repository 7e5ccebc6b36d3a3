"""The unicycle of Trajectron++ (Salzmann et al. 2020, section 4.2 and appendix) in the arithmetic of its
published code: float32, step by step, closed forms, map coordinates.

These divide by powers of the heading rate, down to 0.01 rad/s, and cancel; so their last bits come out
multiplied by up to 1e4. To compare with what was computed so, one has to know how far rounding moves it:
``Released`` can be told to round every intermediate result a little differently.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from model.networks.dynamics import STRAIGHT_BELOW, Controls, Positions
from model.scenes.scene import STEP_SECONDS as DT

FLOAT32_ROUNDING = 2.0**-24
"""Relative, of one operation."""


@dataclass
class Released:
    """``model.networks.dynamics.integrate_unicycle`` in the released arithmetic.

    ``rounding`` is the standard deviation of a relative error put into each intermediate result; 0: none.
    """

    origin: Tensor
    """[N, 2], m, of the agents on the map."""
    rounding: float = 0.0
    generator: torch.Generator = field(default_factory=torch.Generator)

    def __call__(self, controls: Controls, heading: Tensor, speed: Tensor) -> Positions:
        """Means and covariances; arguments as of ``integrate_unicycle``, [N, M, T] and [N, M]."""
        rounded = self._rounded
        controls = Controls(*map(rounded, controls))
        phi, v = rounded(heading), rounded(speed)
        start = self.origin.float()[:, None].expand(*heading.shape, 2)
        x, y = start.unbind(-1)
        sigma = torch.zeros(*heading.shape, 4, 4)
        means, covariances = [], []
        for w, a, ww, wa, aa in zip(*(part.unbind(-1) for part in controls), strict=True):
            straight = w.abs() <= STRAIGHT_BELOW
            step = _Step(phi, v, torch.where(straight, torch.ones_like(w), w), a, rounded)
            line, turn = step.straight(), step.curved()
            dx, dy, by_state, by_control = (
                torch.where(straight.view(straight.shape + (1,) * (one.dim() - 2)), one, two)
                for one, two in zip(line, turn, strict=True)
            )
            by_state, by_control = rounded(by_state), rounded(by_control)
            x, y, v = x + dx, y + dy, v + a * DT
            phi = torch.where(straight, phi, phi + w * DT)
            control = _matrix([[ww, wa], [wa, aa]])
            sigma = rounded(by_state @ (sigma @ by_state.mT) + by_control @ (control @ by_control.mT))
            means.append(torch.stack([x, y], dim=-1))
            covariances.append(sigma[..., :2, :2])
        mean = torch.stack(means, dim=-2) - start[..., None, :]
        return Positions(mean, torch.stack(covariances, dim=-3))

    def _rounded(self, value: Tensor) -> Tensor:
        if not self.rounding:
            return value
        return value * (1 + self.rounding * torch.randn(value.shape, generator=self.generator))


@dataclass
class _Step:
    """One step of the unicycle from heading φ and speed v, and its Jacobians."""

    phi: Tensor
    v: Tensor
    w: Tensor
    a: Tensor
    rounded: Callable[[Tensor], Tensor]

    def straight(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return displacement by x and y, Jacobians by the state [4, 4] and the controls [4, 2]."""
        v, a, sin, cos = self.v, self.a, self.phi.sin(), self.phi.cos()
        way = v * DT + a / 2 * DT**2
        dx, dy = way * cos, way * sin
        half = DT**2 / 2
        by_state = self._by_state(-dy, cos * DT, dx, sin * DT)
        zero, one = torch.zeros_like(v), torch.ones_like(v)
        by_control = _matrix([[zero, half * cos], [zero, half * sin], [zero, zero], [zero, DT * one]])
        return dx, dy, by_state, by_control

    def curved(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return what ``straight`` returns, for a turning vehicle."""
        v, w, a, after = self.v, self.w, self.a, self.phi + self.w * DT
        sin, cos, sin_after, cos_after = map(
            self.rounded, (self.phi.sin(), self.phi.cos(), after.sin(), after.cos())
        )
        dsin, dcos = (sin_after - sin) / w, (cos_after - cos) / w
        dx = (a / w) * dcos + v * dsin + (a / w) * sin_after * DT
        dy = -v * dcos + (a / w) * dsin - (a / w) * cos_after * DT
        by_state = self._by_state(
            -(a / w) * dsin + v * dcos + (a / w) * cos_after * DT,
            dsin,
            v * dsin + (a / w) * dcos + (a / w) * sin_after * DT,
            -dcos,
        )
        twice = 2 * a / w**2
        x_w = (v / w) * cos_after * DT - (v / w) * dsin - twice * sin_after * DT - twice * dcos
        y_w = (v / w) * dcos + (v / w) * sin_after * DT - twice * dsin + twice * cos_after * DT
        x_w, y_w = x_w + (a / w) * cos_after * DT**2, y_w + (a / w) * sin_after * DT**2
        x_a, y_a = (1 / w) * dcos + (1 / w) * sin_after * DT, (1 / w) * dsin - (1 / w) * cos_after * DT
        zero, one = torch.zeros_like(v), torch.ones_like(v)
        return dx, dy, by_state, _matrix([[x_w, x_a], [y_w, y_a], [DT * one, zero], [zero, DT * one]])

    def _by_state(self, x_phi: Tensor, x_v: Tensor, y_phi: Tensor, y_v: Tensor) -> Tensor:
        o, i = torch.zeros_like(self.v), torch.ones_like(self.v)
        return _matrix([[i, o, x_phi, x_v], [o, i, y_phi, y_v], [o, o, i, o], [o, o, o, i]])


def _matrix(rows: list[list[Tensor]]) -> Tensor:
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
