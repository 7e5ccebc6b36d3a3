"""Parts of the context taken away at random."""

import torch

from loadtest.forward import features_in_agent_frame
from model.data import hiding
from model.data.packing import UNKNOWN, unpack_patches
from model.forecaster import Features

COUNT = 4000


def _features() -> Features:
    features = features_in_agent_frame(2)
    packed = torch.full((COUNT, 20, 20), 21, dtype=torch.uint8)
    repeated = {name: values[:1].expand(COUNT, *values.shape[1:]) for name, values in features.items()}
    return repeated | {"map": packed, "far_map": packed.clone()}


def test_shares_of_what_is_hidden() -> None:
    torch.manual_seed(0)
    features = _features()
    hidden = hiding.hide_context(features)
    no_near, no_far = ((hidden[name] == UNKNOWN).flatten(1).all(dim=1).float() for name in ("map", "far_map"))
    assert abs(no_near.mean() - (hiding.NO_MAP + hiding.NO_NEAR_MAP)) < 0.015
    assert abs(no_far.mean() - (hiding.NO_MAP + hiding.NO_FAR_MAP)) < 0.02
    assert abs((no_near * no_far).mean() - hiding.NO_MAP) < 0.015
    alone = (hidden["neighbors"] == 0).flatten(1).all(dim=1).float()
    assert abs(alone.mean() - hiding.NO_NEIGHBORS) < 0.015


def test_a_short_map_ends_at_a_row_and_is_whole_before_it() -> None:
    torch.manual_seed(0)
    hidden = hiding.hide_context(_features())["far_map"]
    unknown = hidden == UNKNOWN
    short = unknown.flatten(1).any(dim=1) & ~unknown.flatten(1).all(dim=1)
    assert abs(short.float().mean() - hiding.SHORT_MAP) < 0.02
    rows = unknown[short]
    assert (rows.all(dim=2) == rows.any(dim=2)).all()  # whole rows
    first = rows.all(dim=2).int().argmax(dim=1)
    assert first.min() >= 5
    assert (rows.all(dim=2).sum(dim=1) == 20 - first).all()  # and all behind the first


def test_what_is_given_stays_as_it_is_and_unknown_reads_as_zero() -> None:
    torch.manual_seed(0)
    features = _features()
    before = {name: values.clone() for name, values in features.items()}
    hidden = hiding.hide_context(features)
    for name, values in before.items():
        assert torch.equal(features[name], values), name
    for name in features.keys() - {"map", "far_map", "neighbors"}:
        assert hidden[name] is features[name]
    gone = (hidden["map"] == UNKNOWN).flatten(1).all(dim=1)
    assert unpack_patches(hidden["map"][gone]).abs().max() == 0
