"""The recurrent cells against torch's."""

import torch

from model.networks.recurrent import GRUCell, HistoryLSTM


def test_a_whole_history_is_encoded_as_by_torch() -> None:
    torch.manual_seed(0)
    ours, inputs = HistoryLSTM(5, 7), torch.randn(3, 4, 5)
    theirs = torch.nn.LSTM(5, 7, batch_first=True)
    names = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
    theirs.load_state_dict({f"{name}_l0": getattr(ours, name).data for name in names})
    _, (hidden, _) = theirs(inputs)
    torch.testing.assert_close(ours(inputs, torch.zeros(3, dtype=torch.long)), hidden[0])


def test_frames_before_the_first_observed_one_do_not_count() -> None:
    torch.manual_seed(1)
    cell, inputs = HistoryLSTM(5, 7), torch.randn(2, 4, 5)
    first = torch.tensor([2, 0])
    changed = inputs.clone()
    changed[:, :2] += 10.0
    mixed, other = cell(inputs, first), cell(changed, first)
    torch.testing.assert_close(mixed[0], other[0])
    assert (mixed[1] - other[1]).abs().max() > 1e-3
    alone = cell(inputs[:1, 2:], torch.zeros(1, dtype=torch.long))
    torch.testing.assert_close(mixed[:1], alone)


def test_a_gru_step_is_torchs() -> None:
    torch.manual_seed(2)
    ours, theirs = GRUCell(5, 7), torch.nn.GRUCell(5, 7)
    theirs.load_state_dict(ours.state_dict())
    inputs, hidden = torch.randn(3, 5), torch.randn(3, 7)
    gates = inputs @ ours.weight_ih.T + ours.bias_ih
    reset_update = gates[:, :14] + ours.bias_hh[:14]
    torch.testing.assert_close(ours(reset_update, gates[:, 14:], hidden), theirs(inputs, hidden))
