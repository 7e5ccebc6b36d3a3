"""Validation of a decoded request: its options, its map and its agents.

A fault of the call as a whole raises; a fault of one agent leaves that agent out. A call of 128 agents with
20 states each has 23,000 numbers, most of them optional, and reading each one's value and presence from
protobuf takes longer than many a forecast. States are therefore serialised one by one, which is one call into
C each, and numpy reads their numbers from the bytes: in wire format a double is a tag byte and eight bytes.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from google.protobuf.descriptor import FieldDescriptor

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.bounds import FIELD_BOUNDS, MAX_ID_LENGTH, MAX_PRIORITY, PATCH_PIXELS, STEP_SECONDS
from model.arrays import Bools, Bytes, Float32s, Floats, Ints
from model.forecaster import Context, ModelInfo
from model.scenes.observations import JUMP_SLACK, MAX_SPEED, Observations
from model.scenes.resample import MAX_AGE, TIME_TOLERANCE
from model.scenes.scene import AgentType, Raster
from service.errors import BadField, Fault, TooLarge, id_too_long
from service.predict.map_image import decode_layers
from service.settings import Settings

_PatchName = Literal["map_patch", "far_map_patch"]
_PATCH_NAMES: tuple[_PatchName, ...] = get_args(_PatchName)
_RasterNumber = Literal["origin_x", "origin_y", "pixels_per_meter"]
_RASTER_NUMBERS: tuple[_RasterNumber, ...] = get_args(_RasterNumber)

TYPES = {
    models_pb.AGENT_TYPE_VEHICLE: AgentType.VEHICLE,
    models_pb.AGENT_TYPE_PEDESTRIAN: AgentType.PEDESTRIAN,
    models_pb.AGENT_TYPE_CYCLIST: AgentType.CYCLIST,
    models_pb.AGENT_TYPE_UNKNOWN: AgentType.UNKNOWN,
}
UNKNOWN_TYPE_NAME = -1
"""Agent type that stands for a name that the contract does not have."""
_CONTEXTS = {
    pb.CONTEXT_UNSPECIFIED: Context.FULL,
    pb.CONTEXT_FULL: Context.FULL,
    pb.CONTEXT_BLIND: Context.BLIND,
}
_RECALLS = {
    pb.HISTORY_SOURCE_UNSPECIFIED: False,
    pb.HISTORY_SOURCE_REQUEST: False,
    pb.HISTORY_SOURCE_MEMORY: True,
}

_FIELDS = [field.name for field in pb.AgentState.DESCRIPTOR.fields]
_TIME, _X, _Y, _HEADING, _VX, _VY, _AX, _AY, _RATE = range(9)
_REQUIRED = [_TIME, _X, _Y]
_BYTES_PER_POINT = 16  # of a sample: x and y as double
_PAIRS = [(_VX, _VY), (_AX, _AY)]
_BOUNDS = np.array([FIELD_BOUNDS[f"AgentState.{name}"][1] for name in _FIELDS])  # of the absolute value
_FIXED64 = 1  # wire type
_IS_TAG = np.zeros(256, dtype=np.bool_)
_IS_TAG[[field.number << 3 | _FIXED64 for field in pb.AgentState.DESCRIPTOR.fields]] = True
_DOUBLE_BYTES = 9  # tag and value
_YEAR_2000, _YEAR_2100 = 9.46e8, 4.1e9  # s since the epoch
if len(_FIELDS) != _RATE + 1 or any(
    field.type != FieldDescriptor.TYPE_DOUBLE or field.number != index + 1
    for index, field in enumerate(pb.AgentState.DESCRIPTOR.fields)
):
    raise ImportError("AgentState has changed: service.predict.request reads its wire format")


@dataclass(frozen=True)
class Options:
    """Validated options of a call."""

    time: float
    """Current time, s since the epoch."""
    steps: int
    """Number of forecast steps."""
    context: Context
    max_modes: int
    """Max number of modes in the response; 0: all."""
    merge: bool
    """Flag for merging modes that a planner would not tell apart."""
    samples: int
    seed: int | None
    strict: bool
    predicted: int
    """Number of agents to forecast."""
    scene_id: str
    """Empty if the call is not tracked."""
    recalls: bool
    """Flag for histories from the track memory."""
    priority: int
    """Priority of the call, from 0; a higher one goes first."""
    consistency: bool
    """Flag for each agent's latest consistency in the response."""


@dataclass(frozen=True)
class Agents:
    """Validated agents of one request: N in all, V of them valid."""

    ids: Sequence[str]
    predict: Bools
    """Flags of agents to forecast: [N]."""
    faults: dict[int, Fault]
    """First fault of each invalid agent, by index in the request."""
    duplicates: frozenset[int]
    """Indices of agents whose only fault is that others have the same id: they are seen as neighbours."""
    valid: Ints
    """Indices of the valid agents in the request, duplicates among them: [V]."""
    types: Sequence[AgentType]
    """Types of the valid agents: [V]."""
    observations: Observations | None
    """Observations of the valid agents; None if there are none."""
    patches: dict[int, Bytes | Float32s]
    """Own map patches, each [3, 100, 100], by index among the valid agents."""
    far_patches: dict[int, Bytes | Float32s]
    """Own far map patches, likewise."""


def read_options(request: pb.PredictRequest, info: ModelInfo, settings: Settings) -> Options:
    """Validate everything but agents and map.

    Args:
        request: the request.
        info: the requested model.
        settings: the limits.

    Raises:
        BadField: a field is missing or out of its bounds.
        TooLarge: there are too many agents.
    """
    if len(request.agents) > settings.max_agents:
        raise TooLarge(f"{len(request.agents)} agents; at most {settings.max_agents} are accepted")
    if len(request.scene_id) > MAX_ID_LENGTH:
        raise BadField("scene_id", id_too_long(request.scene_id))
    if not request.HasField("time"):
        raise BadField("time", "is required")
    _check_number("time", request.time, *FIELD_BOUNDS["PredictRequest.time"])

    options = request.options
    context = _CONTEXTS.get(options.context)
    if context is None:
        raise BadField("options.context", f"unknown value {options.context}")
    if context is Context.BLIND and not info.supports_blind:
        raise BadField("options.context", f"{info.name} has no blind forecast")
    if options.history not in _RECALLS:
        raise BadField("options.history", f"unknown value {options.history}")
    if options.priority > MAX_PRIORITY:
        raise BadField("options.priority", f"must be at most {MAX_PRIORITY}")
    recalls = _RECALLS[options.history]
    for name, requested in (("history", recalls), ("consistency", options.consistency)):
        if requested and not request.scene_id:
            raise BadField(f"options.{name}", "needs a scene_id")
    predicted = sum(not agent.HasField("predict") or agent.predict for agent in request.agents)
    if options.samples > settings.max_samples:
        raise BadField("options.samples", f"at most {settings.max_samples}")
    if options.samples * predicted > settings.max_samples_per_call:
        raise BadField(
            "options.samples",
            f"{options.samples} × {predicted} agents; at most {settings.max_samples_per_call} in a call",
        )
    steps = _steps(options, info)
    size = options.samples * predicted * steps * _BYTES_PER_POINT
    if size > settings.max_response_bytes:
        raise BadField(
            "options.samples",
            f"{options.samples} × {predicted} agents × {steps} steps are {size} bytes; at most "
            f"{settings.max_response_bytes} in a response",
        )
    return Options(
        time=request.time,
        steps=steps,
        context=context,
        max_modes=options.max_modes,
        merge=options.merge,
        samples=options.samples,
        seed=options.seed if options.HasField("seed") else None,
        strict=options.strict,
        predicted=predicted,
        scene_id=request.scene_id,
        recalls=recalls,
        priority=options.priority,
        consistency=options.consistency,
    )


def read_raster(request: pb.PredictRequest, settings: Settings) -> Raster | None:
    """Return the map of the whole scene; None if the request has none.

    Raises:
        BadField: a field of the map is missing, out of its bounds, or contradicts another.
    """
    return decode_raster(request.scene_raster, settings) if request.HasField("scene_raster") else None


def decode_raster(raster: pb.SceneRaster, settings: Settings) -> Raster:
    """Return a map whose message holds its image; its digest is not checked.

    Raises:
        BadField: a field of the map is missing, out of its bounds, or contradicts another.
    """
    for number in _RASTER_NUMBERS:
        if not raster.HasField(number):
            raise BadField(f"scene_raster.{number}", "is required")
        bounds = FIELD_BOUNDS[f"SceneRaster.{number}"]
        _check_number(f"scene_raster.{number}", getattr(raster, number), *bounds)
    if raster.image.WhichOneof("encoding") == "packed_bits":
        for name, size in (("rows", raster.rows), ("columns", raster.columns)):
            if size == 0:
                raise BadField(f"scene_raster.{name}", "is required with packed_bits")
    if raster.rows * raster.columns > settings.max_raster_pixels:
        raise BadField(
            "scene_raster.rows",
            f"{raster.rows} × {raster.columns} pixels; at most {settings.max_raster_pixels} are accepted",
        )
    layers = decode_layers(
        raster.image,
        "scene_raster.image",
        raster.rows or None,
        raster.columns or None,
        settings.max_raster_pixels,
    )
    origin = np.array([raster.origin_x, raster.origin_y])
    return Raster(layers=layers, origin=origin, pixels_per_meter=raster.pixels_per_meter)


def read_agents(request: pb.PredictRequest, settings: Settings) -> Agents:
    """Validate each agent on its own, and report the first fault of each, in the order of its fields.

    Args:
        request: the request, with a valid ``time``.
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
    uses = Counter(ids)
    duplicates = frozenset(index for index in valid if uses[ids[index]] > 1)
    observations = table.observations(faults) if valid else None
    for index in duplicates:
        faults[index] = Fault(f"agents[{index}].id", f"{uses[ids[index]]} agents share it")
    return Agents(
        ids=ids,
        predict=predict,
        faults=faults,
        duplicates=duplicates,
        valid=np.array(valid, dtype=np.int64),
        types=[TYPES[agents[index].type] for index in valid],
        observations=observations,
        patches=_by_row(images["map_patch"], valid),
        far_patches=_by_row(images["far_map_patch"], valid),
    )


def _steps(options: pb.PredictOptions, info: ModelInfo) -> int:
    if not options.HasField("horizon"):
        return info.steps
    _check_number("options.horizon", options.horizon, STEP_SECONDS, info.horizon)
    steps = round(options.horizon / STEP_SECONDS)
    if abs(steps * STEP_SECONDS - options.horizon) > 1e-6:
        raise BadField("options.horizon", f"must be a multiple of {STEP_SECONDS} s")
    return steps


def _check_number(field: str, value: float, low: float, high: float) -> None:
    if not math.isfinite(value):
        raise BadField(field, "must be a finite number")
    if not low <= value <= high:
        hint = _unit_hint(value) if field == "time" else ""
        raise BadField(field, f"must be within {low:g} … {high:g}{hint}")


def _unit_hint(time: float) -> str:
    """Return what unit a time too large for seconds has, if it is of this age, as the end of a sentence."""
    for unit, per_second in (("milliseconds", 1e3), ("microseconds", 1e6), ("nanoseconds", 1e9)):
        if _YEAR_2000 <= time / per_second <= _YEAR_2100:
            return f" s; it seems to be in {unit}"
    return ""


def _read_patch(agent: pb.Agent, name: _PatchName, path: str) -> Bytes:
    """Return one of an agent's own map patches: [3, 100, 100].

    Raises:
        BadField: the image is malformed or of another size.
    """
    image: pb.LayerImage = getattr(agent, name).image
    return decode_layers(image, f"{path}.{name}.image", PATCH_PIXELS, PATCH_PIXELS, PATCH_PIXELS**2)


def _by_row(images: Mapping[int, Bytes], valid: Sequence[int]) -> dict[int, Bytes | Float32s]:
    """Return the images of valid agents by index among the valid agents."""
    return {row: images[index] for row, index in enumerate(valid) if index in images}


def _head_faults(request: pb.PredictRequest, ids: Sequence[str], settings: Settings) -> dict[int, Fault]:
    """Return the faults outside the contents of states and patches."""
    faults: dict[int, Fault] = {}
    for index, (agent, agent_id) in enumerate(zip(request.agents, ids, strict=True)):
        path = f"agents[{index}]"
        if not agent_id:
            faults[index] = Fault(f"{path}.id", "is required")
        elif len(agent_id) > MAX_ID_LENGTH:
            faults[index] = Fault(f"{path}.id", id_too_long(agent_id))
        elif agent.type == models_pb.AGENT_TYPE_UNSPECIFIED:
            faults[index] = Fault(f"{path}.type", "type is required")
        elif agent.type == UNKNOWN_TYPE_NAME:
            names = ", ".join(map(models_pb.AgentType.Name, TYPES))
            faults[index] = Fault(f"{path}.type", f"unknown name; it is one of {names}")
        elif agent.type not in TYPES:
            faults[index] = Fault(f"{path}.type", f"unknown value {agent.type}")
        elif not agent.states:
            faults[index] = Fault(f"{path}.states", "at least one is required")
        elif len(agent.states) > settings.max_states:
            faults[index] = Fault(f"{path}.states", f"has {len(agent.states)}; at most {settings.max_states}")
    return faults


def _state_values(states: Sequence[pb.AgentState]) -> tuple[Floats, Bools]:
    """Return values [M, 9], NaN where absent, and their presence [M, 9]."""
    values = np.full((len(states), len(_FIELDS)), np.nan)
    present = np.zeros(values.shape, dtype=np.bool_)
    encoded = [state.SerializeToString() for state in states]
    lengths = np.fromiter(map(len, encoded), dtype=np.int64, count=len(encoded))
    if (lengths > _DOUBLE_BYTES * len(_FIELDS)).any() or (lengths % _DOUBLE_BYTES).any():
        return _state_values(_without_unknown_fields(states))
    pairs = np.frombuffer(b"".join(encoded), dtype=np.uint8).reshape(-1, _DOUBLE_BYTES)
    columns = pairs[:, 0].astype(np.int64) >> 3
    columns -= 1
    if not _IS_TAG[pairs[:, 0]].all():
        return _state_values(_without_unknown_fields(states))
    rows = np.repeat(np.arange(len(states)), lengths // _DOUBLE_BYTES)
    values[rows, columns] = np.ascontiguousarray(pairs[:, 1:]).view("<f8")[:, 0]
    present[rows, columns] = True
    return values, present


def _without_unknown_fields(states: Sequence[pb.AgentState]) -> list[pb.AgentState]:
    """Return copies without the fields of a newer client: only known fields have the plain wire format."""
    copies = []
    for state in states:
        copy = pb.AgentState()
        copy.CopyFrom(state)
        copy.DiscardUnknownFields()
        copies.append(copy)
    return copies


class _StateTable:
    """States of the request's agents, one per row, and their faults."""

    def __init__(self, agents: Ints, counts: Ints, values: Floats, present: Bools, time: float) -> None:
        """
        Args:
            agents: indices of W agents in the request: [W].
            counts: number of states of each: [W].
            values: the values of all states, in the order of the agents: [M, 9].
            present: the presence of the values: [M, 9].
            time: current time, s.
        """
        self._agents = agents
        self._counts = counts
        self._values = values
        self._present = present
        self._now = time
        self._starts = np.cumsum(counts) - counts
        self._owner = np.repeat(np.arange(len(agents)), counts)
        self.faults: dict[int, Fault] = {}
        """First fault of each agent, by index in the request."""

    def find_faults(self) -> None:
        """Fill ``faults``: first those of single values, then of pairs, then between states."""
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
        """Return the observations of the agents without faults, in order.

        Args:
            faults: all faults by index in the request; at least one agent has none.
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
        """Return the first of the rows of each agent without a fault so far.

        Only one fault per agent is reported, and formatting a hundred thousand takes a quarter of a second.

        Args:
            rows: ascending row indices: [R].
        """
        if not rows.size:
            return []
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
        hint = _unit_hint(float(self._values[row, column])) if column == _TIME else ""
        return f"must be within ±{_BOUNDS[column]:g}{hint}"

    def _successive(self) -> Ints:
        """Return the rows that have a predecessor of the same agent."""
        return np.flatnonzero(self._owner[1:] == self._owner[:-1]) + 1

    def _find_time_faults(self) -> None:
        times = self._values[:, _TIME]
        for row in self._first_of_each(np.flatnonzero(times > self._now + TIME_TOLERANCE)):
            self._add(row, "time", f"is {times[row] - self._now:.3g} s after the request's time")
        # An observation within the tolerance of the current time counts as current.
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
