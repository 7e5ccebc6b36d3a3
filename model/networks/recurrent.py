"""The recurrent cells: an LSTM over histories of different lengths, and a fast GRU cell."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class HistoryLSTM(nn.Module):
    """An LSTM over right-aligned histories: the state stays zero until an agent's first observed frame."""

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__()
        self.hidden_size = hidden_size
        bound = 1 / math.sqrt(hidden_size)  # as torch.nn.LSTM

        def parameter(*shape: int) -> nn.Parameter:
            return nn.Parameter(torch.empty(*shape).uniform_(-bound, bound))

        self.weight_ih = parameter(4 * hidden_size, input_size)
        self.weight_hh = parameter(4 * hidden_size, hidden_size)
        self.bias_ih = parameter(4 * hidden_size)
        self.bias_hh = parameter(4 * hidden_size)

    def forward(self, inputs: Tensor, first: Tensor) -> Tensor:
        """Return the hidden state after the last frame.

        Args:
            inputs: [N, F, D].
            first: [N] int64, the first observed frame.

        Returns:
            [N, hidden_size].
        """
        gates_in = F.linear(inputs, self.weight_ih, self.bias_ih + self.bias_hh)
        hidden = inputs.new_zeros(inputs.shape[0], self.hidden_size)
        cell = hidden
        started = torch.arange(inputs.shape[1], device=inputs.device)[:, None] >= first  # [F, N]
        if torch.compiler.is_exporting():  # an exported graph cannot depend on values; the result is the same
            everywhere = [False] * inputs.shape[1]
        else:
            everywhere = started.all(dim=1).tolist()
        for frame in range(inputs.shape[1]):
            gates = torch.addmm(gates_in[:, frame], hidden, self.weight_hh.T)
            keep, forget, new, out = gates.chunk(4, dim=1)
            next_cell = torch.sigmoid(forget) * cell + torch.sigmoid(keep) * torch.tanh(new)
            next_hidden = torch.sigmoid(out) * torch.tanh(next_cell)
            if everywhere[frame]:
                cell, hidden = next_cell, next_hidden
            else:
                on = started[frame][:, None]
                cell = torch.where(on, next_cell, cell)
                hidden = torch.where(on, next_hidden, hidden)
        return hidden


class GRUCell(nn.Module):
    """A GRU cell that takes the contribution of its input to the gates instead of the input.

    The decoder's input is constant over the steps except for two numbers, so that its product with the
    weights is computed once (REFERENCE: 42 MFLOP per agent instead of 70).
    """

    def __init__(self, input_size: int, hidden_size: int) -> None:
        super().__init__()
        self.hidden_size = hidden_size
        bound = 1 / math.sqrt(hidden_size)  # as torch.nn.GRUCell

        def parameter(*shape: int) -> nn.Parameter:
            return nn.Parameter(torch.empty(*shape).uniform_(-bound, bound))

        self.weight_ih = parameter(3 * hidden_size, input_size)
        self.weight_hh = parameter(3 * hidden_size, hidden_size)
        self.bias_ih = parameter(3 * hidden_size)
        self.bias_hh = parameter(3 * hidden_size)

    def forward(self, reset_update_in: Tensor, new_in: Tensor, hidden: Tensor) -> Tensor:
        """Return the next hidden state.

        Args:
            reset_update_in: [N, 2·hidden_size], contribution of the input to these gates, both biases
                included; overwritten.
            new_in: [N, hidden_size], contribution of the input to the candidate, its bias included.
            hidden: [N, hidden_size]; the weights are cast to the dtype that all three have.
        """
        size = self.hidden_size
        weight, bias = self.weight_hh.to(hidden.dtype), self.bias_hh.to(hidden.dtype)
        gates = reset_update_in.addmm_(hidden, weight[: 2 * size].T).sigmoid_()
        candidate = F.linear(hidden, weight[2 * size :], bias[2 * size :])
        # tanh(x) = 2σ(2x) − 1: on CPUs the sigmoid takes a third of the time of tanh
        new = torch.sigmoid(2 * torch.addcmul(new_in, gates[:, :size], candidate)) * 2 - 1
        return torch.lerp(new, hidden, gates[:, size:])
