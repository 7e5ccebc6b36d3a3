"""Warnings of a call: what contradicts itself in the input of its agents, as messages of the contract."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.scenes.plausibility import Contradiction, find_breaks, find_contradictions
from model.scenes.resample import TIME_TOLERANCE
from model.scenes.scene import Raster
from service.predict.request import Agents
from service.tracking.store.records import unpack_observations
from service.tracking.tracker import TrackingResult

Warnings: TypeAlias = dict[int, list[pb.InputWarning]]
"""Warnings of agents by their index in the request."""

CODES: Mapping[Contradiction, pb.InputWarningCode.ValueType] = {
    kind: pb.InputWarningCode.Value(f"INPUT_WARNING_CODE_{kind.name}") for kind in Contradiction
}
_OF_THE_SCENE = (pb.INPUT_WARNING_CODE_OFF_MAP, pb.INPUT_WARNING_CODE_TIME_BACKWARDS)
"""Codes that the agents with a forecast have, too."""
HISTORY_S = 2.1
"""Seconds of history that the track memory is asked for, where it is not recalled for the forecast."""
_PREFIX = "INPUT_WARNING_CODE_"


def code_names() -> list[str]:
    """Return the names of all codes of warnings, as labels of metrics."""
    return [code_name(code) for code in pb.InputWarningCode.values() if code]


def code_name(code: "pb.InputWarningCode.ValueType") -> str:
    """Return the name of a code as a label of metrics."""
    return pb.InputWarningCode.Name(code).removeprefix(_PREFIX).lower()


def input_warnings(request: pb.PredictRequest, agents: Agents, raster: Raster | None) -> Warnings:
    """Return the warnings of a call's agents, from the request and what was recalled.

    Args:
        request: the request.
        agents: its agents, with their histories.
        raster: the map of the scene, if it has one.
    """
    warnings: Warnings = {}
    for index in sorted(agents.duplicates):
        path = f"agents[{index}].id"
        detail = "several agents have this id; none of them is forecast"
        warnings[index] = [_warning(pb.INPUT_WARNING_CODE_DUPLICATE_ID, path, detail)]
    observations = agents.observations
    if observations is None:
        return warnings
    for finding in find_contradictions(observations, agents.types, raster, agents.patches):
        index = int(agents.valid[finding.row])
        path = _map_path(index, finding.row, agents)
        if finding.kind is not Contradiction.OFF_MAP:
            time = float(observations.time[finding.row, finding.state])
            path = _state_path(request.agents[index].states, index, time, finding.value)
        warnings.setdefault(index, []).append(_warning(CODES[finding.kind], path, finding.detail))
    return warnings


def memory_warnings(agents: Agents, tracked: TrackingResult, histories: Mapping[str, bytes]) -> Warnings:
    """Return the warnings of a call's agents that the track memory gives.

    Args:
        agents: the agents of the call.
        tracked: the first response of the track memory in the call.
        histories: observations by id that are not among those of ``agents``.
    """
    warnings: Warnings = {}
    if not tracked.answered:
        return warnings
    indices = {agents.ids[i]: i for i in agents.valid.tolist() if i not in agents.duplicates}
    for agent_id, index in indices.items():
        found = warnings[index] = []
        if tracked.behind_s:
            before = f"is {tracked.behind_s:.3g} s before an earlier call of the scene"
            detail = f"{before}: did it come late, or was the clock set back?"
            found.append(_warning(pb.INPUT_WARNING_CODE_TIME_BACKWARDS, "time", detail))
        elif tracked.agents.get(agent_id) == consistency_pb.TRACKING_STATUS_RESET:
            detail = "too far from where the track memory has it: the id of another object?"
            path = f"agents[{index}].states"
            found.append(_warning(pb.INPUT_WARNING_CODE_OTHER_OBJECT, path, detail))
        if agent_id in tracked.retyped:
            detail = "the track memory has another type; the track goes on"
            found.append(_warning(pb.INPUT_WARNING_CODE_TYPE_CHANGED, f"agents[{index}].type", detail))
    remembered = [agent_id for agent_id in indices if histories.get(agent_id)]
    if remembered:
        seen = unpack_observations([histories[agent_id] for agent_id in remembered])
        for finding in find_breaks(seen):
            index = indices[remembered[finding.row]]
            detail = f"with the track memory, {finding.detail}"
            warnings[index].append(_warning(CODES[finding.kind], f"agents[{index}].states", detail))
    return warnings


def add_warnings(response: pb.PredictResponse, indices: Sequence[int], warnings: Warnings) -> None:
    """Add warnings to a response, except codes that an agent has already.

    Args:
        response: the response.
        indices: index in the request of each of its forecasts.
        warnings: the warnings.
    """
    for index, forecast in zip(indices, response.forecasts, strict=True):
        known = {warning.code for warning in forecast.warnings}
        forecast.warnings.extend(one for one in warnings.get(index, ()) if one.code not in known)
    response.warnings.extend(of_context_agents(warnings, indices))


def of_context_agents(warnings: Warnings, forecast: Sequence[int]) -> list[str]:
    """Return the warnings of agents without a forecast to which they could be added, as texts.

    Args:
        warnings: all warnings of the call.
        forecast: indices of the agents in the response.
    """
    shown = set(forecast)
    return [
        f"{one.field} of a context agent: {one.detail}"
        for index in sorted(warnings.keys() - shown)
        for one in warnings[index]
        if one.code not in _OF_THE_SCENE
    ]


def _warning(code: "pb.InputWarningCode.ValueType", field: str, detail: str) -> pb.InputWarning:
    return pb.InputWarning(code=code, field=field, detail=detail)


def _map_path(index: int, row: int, agents: Agents) -> str:
    return f"agents[{index}].map_patch" if row in agents.patches else "scene_raster"


def _state_path(states: Sequence[pb.AgentState], index: int, time: float, value: str) -> str:
    """Return the path of a value of the state of that time; of a recalled one, that of the states."""
    given = np.array([state.time for state in states])
    at = int(np.abs(given - time).argmin())
    if abs(given[at] - time) > TIME_TOLERANCE:
        return f"agents[{index}].states"
    return f"agents[{index}].states[{at}].{value}"
