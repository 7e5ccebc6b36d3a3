"""Packed fields: the same message as by protobuf's own way."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Floats
from service.predict.wire import packed_doubles, packed_tag, varint

_SHAPES = array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=12)
FORECAST = pb.AgentForecast.DESCRIPTOR


@given(
    st.dictionaries(st.sampled_from(["weights", "means", "covariances", "samples"]), arrays("f8", _SHAPES))
)
def test_fields_from_bytes_are_those_from_numbers(fields: dict[str, Floats]) -> None:
    slow, fast = pb.AgentForecast(agent_id="a"), pb.AgentForecast(agent_id="a")
    for name, values in fields.items():
        getattr(slow, name).extend(values.ravel().tolist())
        fast.MergeFromString(packed_doubles(packed_tag(FORECAST, name), values))
    assert fast.SerializeToString(deterministic=True) == slow.SerializeToString(deterministic=True)


def test_the_elements_of_a_part_of_an_array_are_in_its_order() -> None:
    values = np.arange(60.0).reshape(5, 3, 4)[::2, :, 1:3]
    encoded = packed_doubles(packed_tag(FORECAST, "means"), values)
    assert list(pb.AgentForecast.FromString(encoded).means) == values.ravel().tolist()


@given(st.integers(0, 2**32 - 1))
def test_a_varint_is_that_of_protobuf(value: int) -> None:
    tag = varint(pb.AgentForecast.HISTORY_FRAMES_FIELD_NUMBER << 3)
    assert pb.AgentForecast.FromString(tag + varint(value)).history_frames == value


@pytest.mark.parametrize("name", ["mode_ids", "remaining_weight", "agent_id"])
def test_a_tag_is_of_packed_doubles_only(name: str) -> None:
    with pytest.raises(ValueError, match=f"AgentForecast.{name} is no packed field"):
        packed_tag(FORECAST, name)
