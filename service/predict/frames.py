"""Frames for watchers: what one call saw and forecast, with merged modes and rounded numbers.

A frame is made as a document in the contract's JSON mapping, whose long fields are arrays. JSON is written of
it at once; the message is made where somebody needs it.
"""

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import orjson
import torch

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as predict_pb
from cab.forecast.v1 import scene_service_pb2 as pb
from model.arrays import Floats
from model.scenes.scene import STEP_SECONDS, AgentStates
from service.predict.batcher import seconds_in_model
from service.predict.catalog import reference
from service.predict.encode import TRIANGLE, softmax
from service.predict.plan import Group, Plan
from service.predict.wire import packed_doubles, packed_tag
from service.tracking.messages import model_document

MAX_MODES = 5
"""Max number of merged modes of an agent."""
Document = dict[str, Any]
_ARRAYS = {name: packed_tag(pb.FrameAgent.DESCRIPTOR, name) for name in ("weights", "means", "covariances")}
"""Tags of the fields that are arrays in a document."""
_WEIGHT_DECIMALS, _POSITION_DECIMALS, _COVARIANCE_DECIMALS, _STATE_DECIMALS = 4, 2, 4, 3
_STATE_FIELDS = [field.name for field in predict_pb.AgentState.DESCRIPTOR.fields]
_NONE: Floats = np.empty(0)
_TYPES = frozenset(models_pb.AgentType.values())


def build_frame(
    request: predict_pb.PredictRequest,
    plan: Plan,
    forecasts: Sequence[predict_pb.AgentForecast],
    consistency: Mapping[str, Document],
    *,
    shadow: bool,
    map_digest: bytes,
) -> Document:
    """Return the frame of a call as a document. Takes milliseconds: run it in a thread.

    Args:
        request: the request.
        plan: its plan, whose groups have run.
        forecasts: the forecasts of the response, in the order of the plan's drafts; of the shadow none.
        consistency: consistency at the newest observation by agent id.
        shadow: whether the shadow model forecast.
        map_digest: digest of the map that the call saw; empty: it saw none.
    """
    outcomes = [group.outcome for group in plan.groups if group.outcome is not None]
    agents = _agents(request, plan)
    for draft in plan.drafts:
        shown = agents[draft.index]
        shown["predicted"] = bool(plan.agents.predict[draft.index])
        shown["status"] = predict_pb.ForecastStatus.Name(draft.status)
        shown["detail"] = draft.detail
        latest = consistency.get(draft.agent_id)
        if latest is not None and draft.forecaster is not None:
            shown["consistency"] = latest
    for draft, forecast in zip(plan.drafts, forecasts, strict=False):
        agents[draft.index]["warnings"] = _warnings(forecast.warnings)
    for group in plan.groups:
        if group.outcome is not None and group.drafts:
            _add_modes([agents[draft.index] for draft in group.drafts], group)
    return {
        "scene_id": plan.options.scene_id,
        "time": plan.options.time,
        "model": model_document(reference(plan.forecaster.info)),
        "shadow": shadow,
        "map_digest": base64.b64encode(map_digest).decode(),
        "inference_seconds": seconds_in_model(outcomes),
        "queue_seconds": min((outcome.queue for outcome in outcomes), default=0.0),
        "steps": plan.options.steps,
        "step": STEP_SECONDS,
        "agents": agents,
    }


def frame_json(document: Document) -> bytes:
    """Return the event of a frame as JSON, as the contract's mapping has it."""
    return orjson.dumps({"frame": document}, option=orjson.OPT_SERIALIZE_NUMPY)


def frame_message(document: Document) -> pb.WatchForecastsResponse:
    """Return the event of a frame as a message."""
    event = pb.WatchForecastsResponse()
    frame = event.frame
    rest = {name: value for name, value in document.items() if name not in ("agents", "map_digest")}
    frame.MergeFrom(pb.ForecastFrame(**rest, map_digest=base64.b64decode(document["map_digest"])))
    for agent in document["agents"]:
        plain = {name: value for name, value in agent.items() if name not in _ARRAYS}
        shown = frame.agents.add(**plain)
        shown.MergeFromString(b"".join(packed_doubles(tag, agent[name]) for name, tag in _ARRAYS.items()))
    return event


def frame_bytes(document: Document) -> int:
    """Return about how many bytes a frame takes in protobuf."""
    agents = document["agents"]
    numbers = sum(agent[name].nbytes for agent in agents for name in _ARRAYS)
    return 1024 * (1 + len(agents)) + int(numbers)


def _agents(request: predict_pb.PredictRequest, plan: Plan) -> list[Document]:
    """Return all agents with what the models saw of them, or the newest state that was sent."""
    scene = plan.scene
    table, first = _NONE, []
    if scene is not None:
        table, first = _table(scene.states, plan.options.time), scene.states.first.tolist()
    agents = []
    for index, sent in enumerate(request.agents):
        row = plan.rows.get(index)
        agents.append(
            {
                "id": sent.id,
                "type": models_pb.AgentType.Name(sent.type) if sent.type in _TYPES else sent.type,
                "predicted": False,
                "status": "FORECAST_STATUS_UNSPECIFIED",
                "detail": "",
                "warnings": _warnings(plan.input_warnings.get(index, ())),
                "states": _newest(sent) if row is None else _states(table[row, first[row] :]),
                "weights": _NONE,
                "means": _NONE,
                "covariances": _NONE,
            }
        )
    return agents


def _states(table: Floats) -> list[Document]:
    """Return states [F, 9] as documents; what is not known is left out."""
    states = [dict(zip(_STATE_FIELDS, values, strict=True)) for values in table.tolist()]
    if math.isfinite(float(table.sum())):
        return states
    return [{name: value for name, value in state.items() if not math.isnan(value)} for state in states]


def _newest(agent: predict_pb.Agent) -> list[Document]:
    """Return the newest state of an agent as it was sent, if all of it is numbers and a position."""
    if not agent.states:
        return []
    state = {field.name: value for field, value in agent.states[-1].ListFields()}
    usable = {"x", "y"} <= state.keys() and all(map(math.isfinite, state.values()))
    return [state] if usable else []


def _warnings(warnings: Sequence[predict_pb.InputWarning]) -> list[Document]:
    return [
        {
            "code": predict_pb.InputWarningCode.Name(warning.code),
            "detail": warning.detail,
            "field": warning.field,
        }
        for warning in warnings
    ]


def _table(states: AgentStates, time: float) -> Floats:
    """Return the states as [N, F, 9], in the order of the fields of the contract's state."""
    agents, frames = states.heading.shape
    table: Floats = np.empty((agents, frames, len(_STATE_FIELDS)))
    table[..., 0] = time - STEP_SECONDS * np.arange(frames - 1, -1, -1)
    table[..., 1:3] = states.position
    table[..., 3] = states.heading
    table[..., 4:6] = states.velocity
    table[..., 6:8] = states.acceleration
    table[..., 8] = states.heading_rate
    table[..., 1:] = table[..., 1:].round(_STATE_DECIMALS) + 0.0  # no negative zeros
    return table


def _add_modes(agents: Sequence[Document], group: Group) -> None:
    """Add the most likely merged modes of N agents."""
    with torch.inference_mode():
        merged = group.merged()
    mixture, counts = merged.mixture, merged.counts.numpy()
    weights = softmax(mixture.log_weights.numpy().astype(np.float64))
    order = np.argsort(-weights, axis=1, kind="stable")[:, :MAX_MODES]
    rows = np.arange(len(agents))[:, None]
    weights = weights[rows, order].round(_WEIGHT_DECIMALS)
    means: Floats = mixture.means.numpy()[rows, order] + mixture.origin.numpy()[:, None, None]
    means = means.round(_POSITION_DECIMALS) + 0.0
    covariances = mixture.covariances.numpy()[rows, order]
    triangles: Floats = np.empty((*covariances.shape[:-2], 3))
    for place, (row, column) in enumerate(TRIANGLE):
        triangles[..., place] = covariances[..., row, column]
    triangles = _rounded(triangles)
    for place, (agent, count) in enumerate(zip(agents, counts.tolist(), strict=True)):
        agent["weights"] = weights[place, :count]
        agent["means"] = means[place, :count].reshape(-1)
        agent["covariances"] = triangles[place, :count].reshape(-1)


def _rounded(triangles: Floats) -> Floats:
    """Return rounded covariances [..., 3], which stay covariances."""
    least = 10.0**-_COVARIANCE_DECIMALS
    rounded: Floats = triangles.round(_COVARIANCE_DECIMALS) + 0.0
    rounded[..., [0, 2]] = np.maximum(rounded[..., [0, 2]], least)
    most = np.sqrt(rounded[..., 0] * rounded[..., 2])
    rounded[..., 1] = np.where(np.abs(rounded[..., 1]) < most, rounded[..., 1], 0.0)
    return rounded
