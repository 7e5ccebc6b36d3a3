"""The decoder: one mode per latent category, one Gaussian of the controls per step."""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.networks.config import DECODER_HIDDEN
from model.networks.dynamics import Controls
from model.networks.recurrent import GRUCell


class ModeDecoder(nn.Module):
    """A GRU unrolled for every latent category at once (Trajectron++, section 4.2).

    The cell's input is [z, x, a]: the one-hot category, the encoding, and the control of the step before.
    """

    log_sigma_bound: Tensor | None
    """[], maximum logarithm of the controls' standard deviations in prediction; None: no maximum."""

    def __init__(
        self, modes: int, encoding_size: int, state_size: int, max_sigma: float | None = None
    ) -> None:
        super().__init__()
        self.modes = modes
        self.initial_h = nn.Linear(modes + encoding_size, DECODER_HIDDEN)
        self.initial_action = nn.Linear(state_size, 2)
        self.cell = GRUCell(modes + encoding_size + 2, DECODER_HIDDEN)
        self.mean = nn.Linear(DECODER_HIDDEN, 2)
        self.log_sigma = nn.Linear(DECODER_HIDDEN, 2)
        self.correlation = nn.Linear(DECODER_HIDDEN, 1)
        bound = None if max_sigma is None else torch.tensor(math.log(max_sigma))
        self.register_buffer("log_sigma_bound", bound)
        self.training_dtype = torch.float32
        """Type of the unrolled cell in training; the heads and everything after them are in float32."""

    def forward(
        self, encoding: Tensor, state_now: Tensor, steps: int, sample_controls: bool = False
    ) -> Controls:
        """Return the controls of all modes; each step's mean, or a sample, is fed back into the next step.

        Args:
            encoding: [N, X].
            state_now: [N, D], standardised.
            steps: T.
            sample_controls: feed back samples (training) instead of means (prediction).

        Returns:
            [N, K, T] each.
        """
        agents, modes = len(encoding), self.modes
        w_z, of_x, w_a = self._input_weights(encoding)
        h_z, h_x = self.initial_h.weight.split([modes, encoding.shape[1]], dim=1)
        hidden = _outer(h_z, F.linear(encoding, h_x, self.initial_h.bias))
        action = self.initial_action(state_now).repeat_interleave(modes, dim=0)
        outputs = self._unroll([_outer(w_z, of_x)] * steps, w_a, hidden, action, sample_controls)[0]
        # [5, N, K, T], contiguous, because the rest works on whole tensors of one quantity
        stacked = torch.stack(outputs).permute(2, 1, 0).contiguous().unflatten(1, (agents, modes))
        sigma = stacked[2:4].exp()
        covariance = torch.tanh(stacked[4]) * sigma[0] * sigma[1]
        return Controls(stacked[0], stacked[1], sigma[0].square(), covariance, sigma[1].square())

    def sample(self, encoding: Tensor, state_now: Tensor, latents: Tensor) -> Tensor:
        """Sample controls of one category per agent and step, each fed back; differentiable.

        Args:
            encoding: [N, X].
            state_now: [N, D], standardised.
            latents: [N, T] int64, categories; a trajectory whose category changes is a hallucination
                (HalentNet, Zhu et al. 2021).

        Returns:
            [N, T, 2].
        """
        w_z, of_x, w_a = self._input_weights(encoding)
        h_z, h_x = self.initial_h.weight.split([self.modes, encoding.shape[1]], dim=1)
        hidden = F.linear(encoding, h_x, self.initial_h.bias) + h_z.T[latents[:, 0]]
        inputs = [of_x + w_z.T[step] for step in latents.unbind(dim=1)]
        return torch.stack(self._unroll(inputs, w_a, hidden, self.initial_action(state_now), True)[1], dim=1)

    def _input_weights(self, encoding: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the weights of z [3H, K], the contribution of x [N, 3H] and the weights of a [3H, 2]."""
        split = 2 * DECODER_HIDDEN
        bias = self.cell.bias_ih.clone()
        bias[:split] += self.cell.bias_hh[:split]
        w_z, w_x, w_a = self.cell.weight_ih.split([self.modes, encoding.shape[1], 2], dim=1)
        return w_z, F.linear(encoding, w_x, bias), w_a

    def _unroll(
        self, inputs: Sequence[Tensor], w_a: Tensor, hidden: Tensor, action: Tensor, sample_controls: bool
    ) -> tuple[list[Tensor], list[Tensor]]:
        """Return the heads' outputs [R, 5] and the controls fed back [R, 2] of each step, for R rows.

        Args:
            inputs: one [R, 3H] per step, the contribution of z and x to the gates.
            w_a: [3H, 2].
            hidden: [R, H], initial state.
            action: [R, 2], the control before the first step.
            sample_controls: feed back samples instead of means.
        """
        split = 2 * DECODER_HIDDEN
        low = self.training and self.training_dtype is not torch.float32
        dtype = self.training_dtype if low else hidden.dtype
        w_gates, w_new = w_a[:split].T.to(dtype), w_a[split:].T.to(dtype)
        weight = torch.cat([self.mean.weight, self.log_sigma.weight, self.correlation.weight])
        head_bias = torch.cat([self.mean.bias, self.log_sigma.bias, self.correlation.bias])
        upper: Tensor | None = None
        if self.log_sigma_bound is not None and not self.training:
            upper = head_bias.new_full(head_bias.shape, math.inf)
            upper[2:4] = self.log_sigma_bound
        hidden = hidden.to(dtype)
        outputs: list[Tensor] = []
        actions: list[Tensor] = []
        constant: Tensor | None = None
        for given in inputs:
            if given is not constant:  # the same tensor at every step, unless hallucinating
                gates, new = (part.to(dtype).contiguous() for part in (given[:, :split], given[:, split:]))
                constant = given
            fed = action.to(dtype)
            hidden = self.cell(torch.addmm(gates, fed, w_gates), torch.addmm(new, fed, w_new), hidden)
            heads = F.linear(hidden.to(weight.dtype), weight, head_bias)
            outputs.append(heads if upper is None else heads.minimum(upper))
            action = _sample(outputs[-1]) if sample_controls else outputs[-1][:, :2]
            actions.append(action)
        return outputs, actions


def _outer(by_mode: Tensor, by_agent: Tensor) -> Tensor:
    """Add every mode's column to every agent's row: [H, K], [N, H] → [N·K, H].

    z is one-hot, so that its product with the weights is a look-up of a column.
    """
    return (by_agent[:, None, :] + by_mode.T[None, :, :]).flatten(0, 1)


def _sample(outputs: Tensor) -> Tensor:
    """Sample each Gaussian of the controls, differentiably: [N, 5] heads → [N, 2]."""
    mean, sigma, rho = outputs[:, :2], outputs[:, 2:4].exp(), torch.tanh(outputs[:, 4])
    noise = torch.randn_like(mean)
    second = rho * noise[:, 0] + (1 - rho.square()).clamp_min(0).sqrt() * noise[:, 1]
    return mean + sigma * torch.stack([noise[:, 0], second], dim=1)
