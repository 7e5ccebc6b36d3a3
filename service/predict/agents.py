"""The agents of a request: what is wrong with which, and the observations of the others.

A call of 128 agents with 20 states each has 23,000 numbers, most of them optional; asking protobuf for
each one's value and presence would take longer than many a forecast. So states are re-encoded one by
one, which is one call into C each, and their numbers picked out of the bytes by numpy: on the wire a
double is a tag byte and eight bytes.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from google.protobuf.descriptor import FieldDescriptor

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.bounds import FIELD_BOUNDS, MAX_ID_LENGTH, PATCH_PIXELS
from model.arrays import Bools, Bytes, Float32s, Floats, Ints
from model.scenes.observations import JUMP_SLACK, MAX_SPEED, Observations
from model.scenes.resample import MAX_AGE, TIME_TOLERANCE
from model.scenes.scene import AgentType
from service.errors import BadField, Fault, id_too_long
from service.predict.images import decode_layers
from service.settings import Settings

_PatchName = Literal["map_patch", "far_map_patch"]
_PATCH_NAMES: tuple[_PatchName, ...] = get_args(_PatchName)

TYPES = {
    models_pb.AGENT_TYPE_VEHICLE: AgentType.VEHICLE,
    models_pb.AGENT_TYPE_PEDESTRIAN: AgentType.PEDESTRIAN,
    models_pb.AGENT_TYPE_CYCLIST: AgentType.CYCLIST,
    models_pb.AGENT_TYPE_UNKNOWN: AgentType.UNKNOWN,
}

_FIELDS = [field.name for field in pb.AgentState.DESCRIPTOR.fields]
_TIME, _X, _Y, _HEADING, _VX, _VY, _AX, _AY, _RATE = range(9)
_REQUIRED = [_TIME, _X, _Y]
_PAIRS = [(_VX, _VY), (_AX, _AY)]
_BOUNDS = np.array([FIELD_BOUNDS[f"AgentState.{name}"][1] for name in _FIELDS])  # either way
_FIXED64 = 1  # wire type
_TAG_BYTES = np.array([field.number << 3 | _FIXED64 for field in pb.AgentState.DESCRIPTOR.fields])
_DOUBLE_BYTES = 9  # tag and value
if len(_FIELDS) != _RATE + 1 or any(
    field.type != FieldDescriptor.TYPE_DOUBLE or field.number != index + 1
    for index, field in enumerate(pb.AgentState.DESCRIPTOR.fields)
):
    raise ImportError("AgentState has changed: service.predict.agents reads its wire form")


@dataclass(frozen=True)
class Agents:
    """The agents of one request."""

    ids: Sequence[str]
    predict: Bools
    """[N], which ones get a forecast."""
    faults: dict[int, Fault]
    """By index; these agents are left out."""
    valid: Ints
    """[V], indices of the others."""
    types: Sequence[AgentType]
    """[V], of the valid ones."""
    observations: Observations | None
    """Of the valid ones; None when there are none."""
    patches: dict[int, Bytes | Float32s]
    """Own map patches by index among the valid ones, each [3, 100, 100]."""
    far_patches: dict[int, Bytes | Float32s]
    """Own far map patches, likewise."""


def read_agents(request: pb.PredictRequest, settings: Settings) -> Agents:
    """Checks each agent for itself; an agent's first fault is reported, in the order of its fields.

    Args:
        request: with a valid ``time``.
        settings: the limits.
    """
    agents = request.agents
    ids = [agent.id for agent in agents]
    predict = np.array([not agent.HasField("predict") or agent.predict for agent in agents], dtype=np.bool_)
    faults = _head_faults(request, ids, settings)

    whole = [index for index in range(len(agents)) if index not in faults]
    states = [state for index in whole for state in agents[index].states]
    counts = np.array([len(agents[index].states) for index in whole], dtype=np.int64)
    values, present = _state_values(states)
    table = _StateTable(np.array(whole, dtype=np.int64), counts, values, present, request.time)
    table.find_faults()
    faults |= table.faults

    images: dict[_PatchName, dict[int, Bytes]] = {name: {} for name in _PATCH_NAMES}
    for index in whole:
        if index in faults:
            continue
        try:
            for name in _PATCH_NAMES:
                if agents[index].HasField(name):
                    images[name][index] = _read_patch(agents[index], name, f"agents[{index}]")
        except BadField as error:
            faults[index] = error.faults[0]

    valid = [index for index in whole if index not in faults]
    return Agents(
        ids=ids,
        predict=predict,
        faults=faults,
        valid=np.array(valid, dtype=np.int64),
        types=[TYPES[agents[index].type] for index in valid],
        observations=table.observations(faults) if valid else None,
        patches=_by_row(images["map_patch"], valid),
        far_patches=_by_row(images["far_map_patch"], valid),
    )


def _read_patch(agent: pb.Agent, name: _PatchName, here: str) -> Bytes:
    """Return one of an agent's own map patches: [3, 100, 100].

    Raises:
        BadField: it is no such patch.
    """
    image: pb.LayerImage = getattr(agent, name).image
    return decode_layers(image, f"{here}.{name}.image", PATCH_PIXELS, PATCH_PIXELS, PATCH_PIXELS**2)


def _by_row(images: Mapping[int, Bytes], valid: Sequence[int]) -> dict[int, Bytes | Float32s]:
    """Return the images of valid agents by their index among those."""
    return {row: images[index] for row, index in enumerate(valid) if index in images}


def _head_faults(request: pb.PredictRequest, ids: Sequence[str], settings: Settings) -> dict[int, Fault]:
    """Faults outside the states' contents."""
    faults: dict[int, Fault] = {}
    uses = Counter(ids)
    for index, (agent, agent_id) in enumerate(zip(request.agents, ids, strict=True)):
        here = f"agents[{index}]"
        if not agent_id:
            faults[index] = Fault(f"{here}.id", "is required")
        elif len(agent_id) > MAX_ID_LENGTH:
            faults[index] = Fault(f"{here}.id", id_too_long(agent_id))
        elif uses[agent_id] > 1:
            faults[index] = Fault(f"{here}.id", f"{uses[agent_id]} agents share it")
        elif agent.type == models_pb.AGENT_TYPE_UNSPECIFIED:
            faults[index] = Fault(f"{here}.type", "type is required")
        elif agent.type not in TYPES:
            faults[index] = Fault(f"{here}.type", f"unknown value {agent.type}")
        elif not agent.states:
            faults[index] = Fault(f"{here}.states", "at least one is required")
        elif len(agent.states) > settings.max_states:
            faults[index] = Fault(f"{here}.states", f"has {len(agent.states)}; at most {settings.max_states}")
    return faults


def _state_values(states: Sequence[pb.AgentState]) -> tuple[Floats, Bools]:
    """Values [M, 9] and whether they were given [M, 9]; NaN where not."""
    values = np.full((len(states), len(_FIELDS)), np.nan)
    present = np.zeros(values.shape, dtype=np.bool_)
    encoded = [state.SerializeToString() for state in states]
    lengths = np.fromiter(map(len, encoded), dtype=np.int64, count=len(encoded))
    if (lengths > _DOUBLE_BYTES * len(_FIELDS)).any() or (lengths % _DOUBLE_BYTES).any():
        return _state_values(_without_unknown_fields(states))
    pairs = np.frombuffer(b"".join(encoded), dtype=np.uint8).reshape(-1, _DOUBLE_BYTES)
    columns = pairs[:, 0].astype(np.int64) >> 3
    columns -= 1
    if not np.isin(pairs[:, 0], _TAG_BYTES).all():
        return _state_values(_without_unknown_fields(states))
    rows = np.repeat(np.arange(len(states)), lengths // _DOUBLE_BYTES)
    values[rows, columns] = np.ascontiguousarray(pairs[:, 1:]).view("<f8")[:, 0]
    present[rows, columns] = True
    return values, present


def _without_unknown_fields(states: Sequence[pb.AgentState]) -> list[pb.AgentState]:
    """Copies without what a newer client may have sent: only known fields have the plain wire form."""
    copies = []
    for state in states:
        copy = pb.AgentState()
        copy.CopyFrom(state)
        copy.DiscardUnknownFields()
        copies.append(copy)
    return copies


class _StateTable:
    """All states of the request's agents, one a row, and what is wrong with them."""

    def __init__(self, agents: Ints, counts: Ints, values: Floats, present: Bools, time: float) -> None:
        """
        Args:
            agents: [W], indices in the request.
            counts: [W], states of each.
            values: [M, 9], in the order of the agents.
            present: [M, 9].
            time: the present, s.
        """
        self._agents = agents
        self._counts = counts
        self._values = values
        self._present = present
        self._now = time
        self._starts = np.cumsum(counts) - counts
        self._owner = np.repeat(np.arange(len(agents)), counts)
        self.faults: dict[int, Fault] = {}
        """By index in the request; one an agent."""

    def find_faults(self) -> None:
        """Fills ``faults``: contents of single states, then pairs, then what holds between states."""
        values, present = self._values, self._present
        required = np.zeros(len(_FIELDS), dtype=np.bool_)
        required[_REQUIRED] = True
        with np.errstate(invalid="ignore", over="ignore"):
            infinite = present & ~np.isfinite(values)
            outside = present & (np.abs(values) > _BOUNDS)
            wrong = infinite | outside | (required & ~present)
            for row in self._first_of_each(np.flatnonzero(wrong.any(axis=1))):
                column = int(wrong[row].argmax())
                self._add(row, _FIELDS[column], self._value_detail(row, column))
            for first, second in _PAIRS:
                for row in self._first_of_each(np.flatnonzero(present[:, first] != present[:, second])):
                    missing = second if present[row, first] else first
                    self._add(
                        row, _FIELDS[missing], f"give both {_FIELDS[first]} and {_FIELDS[second]} or neither"
                    )
            self._find_time_faults()
            self._find_jumps()

    def observations(self, faults: dict[int, Fault]) -> Observations:
        """What is known of the agents without faults, in order.

        Args:
            faults: by index in the request, from wherever; some agent has none.
        """
        kept = np.array([index not in faults for index in self._agents.tolist()], dtype=np.bool_)
        counts = self._counts[kept]
        flat = self._values[kept[self._owner]]
        rows = np.repeat(np.arange(len(counts)), counts)
        columns = np.arange(len(flat)) - np.repeat(np.cumsum(counts) - counts, counts)
        padded = np.full((len(counts), int(counts.max()), len(_FIELDS)), np.nan)
        padded[:, :, _TIME] = np.inf
        padded[rows, columns] = flat
        return Observations(
            count=counts,
            time=padded[:, :, _TIME],
            position=padded[:, :, [_X, _Y]],
            heading=padded[:, :, _HEADING],
            velocity=padded[:, :, [_VX, _VY]],
            acceleration=padded[:, :, [_AX, _AY]],
            heading_rate=padded[:, :, _RATE],
        )

    def _first_of_each(self, rows: Ints) -> list[int]:
        """The first of these rows of each agent that has no fault yet: only one an agent is told, and to
        put a hundred thousand into words takes a quarter of a second.

        Args:
            rows: [R], ascending.
        """
        owners, firsts = np.unique(self._owner[rows], return_index=True)
        unknown = [int(agent) not in self.faults for agent in self._agents[owners]]
        first_rows: list[int] = rows[firsts[np.array(unknown, dtype=np.bool_)]].tolist()
        return first_rows

    def _add(self, row: int, name: str, detail: str) -> None:
        owner = int(self._owner[row])
        agent = int(self._agents[owner])
        state = row - int(self._starts[owner])
        self.faults[agent] = Fault(f"agents[{agent}].states[{state}].{name}", detail)

    def _value_detail(self, row: int, column: int) -> str:
        if not self._present[row, column]:
            return "is required"
        if not np.isfinite(self._values[row, column]):
            return "must be a finite number"
        return f"must be within ±{_BOUNDS[column]:g}"

    def _successive(self) -> Ints:
        """Rows that have a predecessor in the same agent."""
        return np.flatnonzero(self._owner[1:] == self._owner[:-1]) + 1

    def _find_time_faults(self) -> None:
        times = self._values[:, _TIME]
        for row in self._first_of_each(np.flatnonzero(times > self._now + TIME_TOLERANCE)):
            self._add(row, "time", f"is {times[row] - self._now:.3g} s after the request's time")
        # Within the tolerance of the present an observation counts as of the present.
        np.minimum(times, self._now, out=times)
        after = self._successive()
        for row in self._first_of_each(after[times[after] <= times[after - 1]]):
            self._add(row, "time", "must be after the state before it")
        last = self._starts + self._counts - 1
        for row in self._first_of_each(last[times[last] < self._now - MAX_AGE - TIME_TOLERANCE]):
            age = self._now - times[row]
            self._add(row, "time", f"the newest state is {age:.3g} s old; at most {MAX_AGE} s")

    def _find_jumps(self) -> None:
        after = self._successive()
        step = self._values[after] - self._values[after - 1]
        distance = np.hypot(step[:, _X], step[:, _Y])
        for row in self._first_of_each(after[distance > MAX_SPEED * step[:, _TIME] + JUMP_SLACK]):
            index = int(np.searchsorted(after, row))
            self._add(
                row,
                "x",
                f"jumps {distance[index]:.4g} m in {step[index, _TIME]:.3g} s from the state before it",
            )
