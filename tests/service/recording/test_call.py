"""Histories from the track memory in a recording."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cab.forecast.v1 import prediction_service_pb2 as pb
from service.recording.call import recalled_states
from service.tracking.store.records import OBSERVATION_FIELDS

numbers = st.floats(allow_nan=False, allow_infinity=False)
rows = st.tuples(*[numbers] * 3, *[st.one_of(numbers, st.just(float("nan")))] * (OBSERVATION_FIELDS - 3))


@given(st.lists(rows, max_size=5))
def test_states_hold_every_number_that_was_given_and_no_other(table: list[tuple[float, ...]]) -> None:
    states = recalled_states(np.array(table, dtype="<f8").tobytes())
    assert len(states) == len(table)
    for state, row in zip(states, table, strict=True):
        names = [field.name for field in pb.AgentState.DESCRIPTOR.fields]
        given = {name: value for name, value in zip(names, row, strict=True) if not np.isnan(value)}
        assert {field.name: value for field, value in state.ListFields()} == given
