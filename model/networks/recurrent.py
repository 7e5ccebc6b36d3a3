"""Recurrent cells whose inputs begin at different frames."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class HistoryLSTM(nn.Module):
    """An LSTM over right-aligned histories: state stays zero until an agent's first observed frame."""

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
        """The hidden state after the last frame.

        Args:
            inputs: [N, F, D].
            first: [N] int64, the first frame that counts.

        Returns:
            [N, hidden_size].
        """
        gates_in = F.linear(inputs, self.weight_ih, self.bias_ih + self.bias_hh)
        hidden = inputs.new_zeros(inputs.shape[0], self.hidden_size)
        cell = hidden
        started = torch.arange(inputs.shape[1], device=inputs.device)[:, None] >= first  # [F, N]
        if torch.compiler.is_exporting():  # a graph cannot hang on values; the result is the same
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
    """A GRU cell that takes what its input adds to the gates ready-made.

    The decoder's input is constant over the steps but for two numbers; its product with the weights is
    then computed once (REFERENCE: 42 MFLOP an agent instead of 70).
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
        """The next hidden state.

        Args:
            reset_update_in: [N, 2·hidden_size], what the input adds to these gates, both biases included;
                overwritten.
            new_in: [N, hidden_size], what the input adds to the candidate, its bias included.
            hidden: [N, hidden_size]; all three of one dtype, which the weights are brought to.
        """
        size = self.hidden_size
        weight, bias = self.weight_hh.to(hidden.dtype), self.bias_hh.to(hidden.dtype)
        gates = reset_update_in.addmm_(hidden, weight[: 2 * size].T).sigmoid_()
        candidate = F.linear(hidden, weight[2 * size :], bias[2 * size :])
        # tanh(x) = 2σ(2x) − 1: on CPUs the sigmoid takes a third of tanh's time
        new = torch.sigmoid(2 * torch.addcmul(new_in, gates[:, :size], candidate)) * 2 - 1
        return torch.lerp(new, hidden, gates[:, size:])
