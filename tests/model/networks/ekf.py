"""The dynamics once more, step by step: an extended Kalman filter in float64 with automatic Jacobians.

Written from the motion equations, not from model/networks/dynamics.py, to test that against.
"""

import torch
from torch import Tensor
from torch.func import jacrev, vmap

from model.networks.dynamics import STRAIGHT_BELOW, Controls
from model.scenes.scene import STEP_SECONDS


def _curved(state: Tensor, control: Tensor) -> Tensor:
    """x, y, heading, speed after one step at constant heading rate and acceleration."""
    (x, y, phi, v), (w, a), dt = state.unbind(), control.unbind(), STEP_SECONDS
    after = phi + w * dt
    dsin, dcos = (after.sin() - phi.sin()) / w, (after.cos() - phi.cos()) / w
    dx = v * dsin + a / w * (after.sin() * dt + dcos)
    dy = -v * dcos - a / w * (after.cos() * dt - dsin)
    return torch.stack([x + dx, y + dy, after, v + a * dt])


def _straight(state: Tensor, control: Tensor) -> Tensor:
    """Return the next state without turning."""
    (x, y, phi, v), (_, a), dt = state.unbind(), control.unbind(), STEP_SECONDS
    way = v * dt + a * dt**2 / 2
    return torch.stack([x + way * phi.cos(), y + way * phi.sin(), phi, v + a * dt])


def unicycle(controls: Controls, heading: Tensor, speed: Tensor) -> tuple[Tensor, Tensor]:
    """Means [M, T, 2] and covariances [M, T, 2, 2] of M trajectories, all in float64.

    Args:
        controls: [M, T] each.
        heading: [M].
        speed: [M].
    """
    c = Controls(*(part.double() for part in controls))
    zero = torch.zeros_like(heading, dtype=torch.float64)
    state = torch.stack([zero, zero, heading.double(), speed.double()], dim=-1)
    sigma = torch.zeros(len(state), 4, 4, dtype=torch.float64)
    means, covariances = [], []
    for t in range(c.mean_0.shape[1]):
        u = torch.stack([c.mean_0[:, t], c.mean_1[:, t]], dim=-1)
        flat = [c.variance_0[:, t], c.covariance[:, t], c.covariance[:, t], c.variance_1[:, t]]
        control_sigma = torch.stack(flat, dim=-1).unflatten(-1, (2, 2))
        straight = (u[:, 0].abs() <= STRAIGHT_BELOW)[:, None]
        turning = torch.where(straight, torch.ones_like(u), u)
        parts = []
        for step, argument in ((_straight, u), (_curved, turning)):
            by_state, by_control = vmap(jacrev(step, argnums=(0, 1)))(state, argument)
            parts.append((vmap(step)(state, argument), by_state, by_control))
        state = torch.where(straight, parts[0][0], parts[1][0])
        f = torch.where(straight[..., None], parts[0][1], parts[1][1])
        g = torch.where(straight[..., None], parts[0][2], parts[1][2])
        sigma = f @ sigma @ f.mT + g @ control_sigma @ g.mT
        means.append(state[:, :2])
        covariances.append(sigma[:, :2, :2])
    return torch.stack(means, dim=1), torch.stack(covariances, dim=1)
