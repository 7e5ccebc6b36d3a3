"""Prepared tensors on their way to a peer and back."""

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of

from loadtest.peers.arrays import from_features, join, pack, split, to_features, unpack
from model.forecaster import Features


def features(agents: int) -> Features:
    generator = torch.Generator().manual_seed(agents)
    return {
        "origin": torch.randn(agents, 2, generator=generator).double(),
        "heading": torch.randn(agents, generator=generator).double(),
        "first": torch.zeros(agents, dtype=torch.long),
        "map": torch.randint(-1, 2, (agents, 3, 4, 4), generator=generator).float(),
    }


@given(
    arrays_of.arrays(
        st.sampled_from([np.int8, np.int64, np.float32, np.float64]),
        arrays_of.array_shapes(min_dims=1, max_dims=4, max_side=4),
    )
)
def test_packed_arrays_are_the_same_after_unpacking(array: "np.ndarray[Any, Any]") -> None:
    [(name, received)] = unpack(pack({"name": array})).items()
    assert name == "name"
    assert received.dtype == array.dtype
    np.testing.assert_array_equal(received, array)


@pytest.mark.parametrize("agents", [1, 3])
def test_features_arrive_as_they_were(agents: int) -> None:
    sent = features(agents)
    received = to_features(unpack(pack(from_features(sent))))
    assert received.keys() == sent.keys()
    for name, tensor in sent.items():
        assert received[name].dtype == tensor.dtype
        assert received[name].shape == tensor.shape
        torch.testing.assert_close(received[name], tensor, rtol=0, atol=0)


def test_maps_between_present_and_absent_are_rounded_to_a_byte() -> None:
    sent = torch.linspace(-1, 1, 48).reshape(1, 3, 4, 4)
    received = to_features(from_features({"map": sent}))["map"]
    torch.testing.assert_close(received, sent, rtol=0, atol=0.5 / 127 + 1e-6)


def test_calls_are_split_as_they_were_joined() -> None:
    calls = [from_features(features(agents)) for agents in (2, 1, 3)]
    for call, own in zip(calls, split(join(calls), [2, 1, 3]), strict=True):
        for name, array in call.items():
            np.testing.assert_array_equal(own[name], array)


def test_other_bytes_are_refused() -> None:
    with pytest.raises(ValueError, match="safetensors"):
        unpack(b"not packed")
