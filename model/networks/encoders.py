"""Encoders of history, neighbours, map and, in training, the future."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from model.networks.config import HIDDEN
from model.networks.recurrent import HistoryLSTM
from model.scenes.scene import AgentType

RNN_DROPOUT = 0.25
MAP_DROPOUT = 0.5

ConvShape: TypeAlias = tuple[int, int, int, int]
"""Input channels, output channels, kernel size, stride."""
MAP_LAYERS: tuple[ConvShape, ...] = ((3, 10, 5, 2), (10, 20, 5, 2), (20, 10, 5, 1), (10, 1, 3, 1))


class HistoryEncoder(HistoryLSTM):
    """LSTM over the own standardised history: [N, F, D] → [N, 32]."""

    def __init__(self, state_size: int) -> None:
        super().__init__(state_size, HIDDEN)
        self.dropout = nn.Dropout(RNN_DROPOUT)

    def forward(self, history: Tensor, first: Tensor) -> Tensor:
        encoded: Tensor = self.dropout(super().forward(history, first))
        return encoded


class NeighborEncoder(nn.Module):
    """The neighbours' influence: one LSTM per edge type, attention over the types.

    Trajectron++, section 4.1: neighbours of one type are summed, encoded together with the own history,
    and the types' encodings are combined by additive attention (Bahdanau et al. 2015) with the own
    history's encoding as query.
    """

    def __init__(self, own_size: int, neighbor_sizes: Mapping[AgentType, int]) -> None:
        super().__init__()
        self.types = tuple(neighbor_sizes)
        self.edges = nn.ModuleDict(
            {kind.value: HistoryLSTM(size + own_size, HIDDEN) for kind, size in neighbor_sizes.items()}
        )
        self.w1 = nn.Linear(HIDDEN, HIDDEN, bias=False)
        self.w2 = nn.Linear(HIDDEN, HIDDEN, bias=False)
        self.v = nn.Linear(HIDDEN, 1, bias=False)
        self.dropout = nn.Dropout(RNN_DROPOUT)

    def forward(
        self,
        neighbors: Mapping[AgentType, Tensor],
        history: Tensor,
        first: Tensor,
        edge_mask: Tensor,
        query: Tensor,
    ) -> Tensor:
        """Return the influence of all neighbours.

        Args:
            neighbors: by type, [N, F, D_type], summed standardised histories.
            history: [N, F, D], own standardised history.
            first: [N], own first observed frame.
            edge_mask: [N] in [0, 1].
            query: [N, 32], the own history's encoding.

        Returns:
            [N, 32].
        """
        encodings = []
        for kind in self.types:
            joint = torch.cat([neighbors[kind], history], dim=-1)
            encodings.append(self.dropout(self.edges[kind.value](joint, first)) * edge_mask[:, None])
        encoded = torch.stack(encodings, dim=1)  # [N, types, 32]
        scores = self.v(torch.tanh(self.w1(encoded) + self.w2(query)[:, None, :]))
        influence: Tensor = self.dropout((torch.softmax(scores, dim=1) * encoded).sum(dim=1))
        return influence


class MapEncoder(nn.Module):
    """Convolutions over the map patch: by default [N, 3, 100, 100] in [-1, 1] → [N, 32].

    Args:
        shapes: shape of each layer.
        pixels: number of outputs of the last layer, over all its channels.
        size: length of the encoding.
    """

    def __init__(
        self, shapes: Sequence[ConvShape] = MAP_LAYERS, pixels: int = 256, size: int = HIDDEN
    ) -> None:
        super().__init__()
        self.convs = nn.ModuleList(nn.Conv2d(i, o, k, stride=s) for i, o, k, s in shapes)
        self.project = nn.Linear(pixels, size)
        self.dropout = nn.Dropout(MAP_DROPOUT)
        self.training_dtype = torch.float32
        """Type of the convolutions in training."""

    def forward(self, patches: Tensor) -> Tensor:
        low = self.training and self.training_dtype is not torch.float32
        with torch.autocast(patches.device.type, self.training_dtype, enabled=low):
            for conv in self.convs:
                patches = F.leaky_relu(conv(patches), 0.2)
        encoded: Tensor = self.dropout(self.project(patches.flatten(1).to(self.project.weight.dtype)))
        return encoded

    def null(self, agents: int) -> Tensor:
        """Return the encoding of an unknown map, midway between absent and present: [agents, 32]."""
        blank = self.project.weight.new_zeros(1, 3, 100, 100)
        for conv in self.convs:
            blank = F.leaky_relu(conv(blank), 0.2)
        encoded: Tensor = self.dropout(self.project(blank.flatten(1)).expand(agents, -1))
        return encoded


class FutureEncoder(nn.Module):
    """Bidirectional LSTM over the standardised future, for q(z | x, y): [N, T, 2] → [N, 128]."""

    def __init__(self, state_size: int) -> None:
        super().__init__()
        self.lstm = nn.LSTM(2, HIDDEN, bidirectional=True, batch_first=True)
        self.initial_h = nn.Linear(state_size, HIDDEN)
        self.initial_c = nn.Linear(state_size, HIDDEN)
        self.dropout = nn.Dropout(RNN_DROPOUT)

    def forward(self, future: Tensor, state_now: Tensor) -> Tensor:
        """Return the encoding of the future.

        Args:
            future: [N, T, 2], positions relative to now, standardised.
            state_now: [N, D], standardised.

        Returns:
            [N, 128]: last hidden, then last cell state, each forward and backward.
        """
        hidden, cell = self.initial_h(state_now), self.initial_c(state_now)
        # Only the forward direction starts from the state now
        start = (
            torch.stack([hidden, torch.zeros_like(hidden)]),
            torch.stack([cell, torch.zeros_like(cell)]),
        )
        _, (hidden, cell) = self.lstm(future, start)
        encoded: Tensor = self.dropout(torch.cat([hidden, cell]).permute(1, 0, 2).flatten(1))
        return encoded
