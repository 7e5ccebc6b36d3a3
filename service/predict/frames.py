"""Frames for watchers: what one call saw and forecast, with merged modes and rounded numbers."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import prediction_service_pb2 as predict_pb
from cab.forecast.v1 import scene_service_pb2 as pb
from model.arrays import Floats
from model.mixture import TrajectoryMixture, merge_modes
from model.scenes.scene import STEP_SECONDS, AgentStates
from service.predict.catalog import reference
from service.predict.encode import TRIANGLE, softmax
from service.predict.plan import Plan
from service.predict.wire import packed_doubles, packed_tag

MAX_MODES = 5
"""Max number of merged modes of an agent."""
_WEIGHTS, _MEANS, _COVARIANCES = (
    packed_tag(pb.FrameAgent.DESCRIPTOR, name) for name in ("weights", "means", "covariances")
)
_WEIGHT_DECIMALS, _POSITION_DECIMALS, _COVARIANCE_DECIMALS, _STATE_DECIMALS = 4, 2, 4, 3
_STATE_FIELDS = [field.name for field in predict_pb.AgentState.DESCRIPTOR.fields]


def build_frame(
    request: predict_pb.PredictRequest,
    plan: Plan,
    forecasts: Sequence[predict_pb.AgentForecast],
    consistency: Mapping[str, consistency_pb.InstantConsistency],
    shadow: bool,
) -> pb.ForecastFrame:
    """Return the frame of a call. Takes milliseconds: run it in a thread.

    Args:
        request: the request.
        plan: its plan, whose groups have run.
        forecasts: the forecasts of the response, in the order of the plan's drafts; of the shadow none.
        consistency: consistency at the newest observation by agent id.
        shadow: whether the shadow model forecast.
    """
    outcomes = [group.outcome for group in plan.groups if group.outcome is not None]
    frame = pb.ForecastFrame(
        scene_id=plan.options.scene_id,
        time=plan.options.time,
        model=reference(plan.forecaster.info),
        shadow=shadow,
        inference_seconds=sum(outcome.inference for outcome in outcomes),
        queue_seconds=min((outcome.queue for outcome in outcomes), default=0.0),
        steps=plan.options.steps,
        step=STEP_SECONDS,
    )
    for index, agent in enumerate(request.agents):
        frame.agents.add(id=agent.id, type=agent.type, warnings=plan.input_warnings.get(index, ()))
    _add_states(frame.agents, request, plan)
    for draft in plan.drafts:
        shown = frame.agents[draft.index]
        shown.predicted = bool(plan.agents.predict[draft.index])
        shown.status, shown.detail = draft.status, draft.detail
        latest = consistency.get(draft.agent_id)
        if latest is not None and draft.forecaster is not None:
            shown.consistency.CopyFrom(latest)
    for draft, forecast in zip(plan.drafts, forecasts, strict=False):
        shown = frame.agents[draft.index]
        del shown.warnings[:]
        shown.warnings.extend(forecast.warnings)
    for group in plan.groups:
        if group.outcome is not None and group.drafts:
            _add_modes([frame.agents[draft.index] for draft in group.drafts], group.outcome.mixture)
    return frame


def _add_states(agents: Sequence[pb.FrameAgent], request: predict_pb.PredictRequest, plan: Plan) -> None:
    """Add what the models saw of each agent, or the newest state that was sent where they did not see it."""
    rows = {} if plan.scene is None else plan.rows
    table = None if plan.scene is None else _table(plan.scene.states, plan.options.time)
    for index, (agent, sent) in enumerate(zip(agents, request.agents, strict=True)):
        row = rows.get(index)
        if row is None or table is None or plan.scene is None:
            newest = sent.states[-1] if sent.states else predict_pb.AgentState()
            if math.isfinite(newest.x) and math.isfinite(newest.y) and newest.HasField("x"):
                agent.states.append(newest)
            continue
        for values in table[row, int(plan.scene.states.first[row]) :].tolist():
            known = zip(_STATE_FIELDS, values, strict=True)
            agent.states.add(**{name: value for name, value in known if not math.isnan(value)})


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


def _add_modes(agents: Sequence[pb.FrameAgent], mixture: TrajectoryMixture) -> None:
    """Add the most likely merged modes of N agents."""
    with torch.inference_mode():
        merged = merge_modes(mixture)
    mixture, counts = merged.mixture, merged.counts.numpy()
    weights = softmax(mixture.log_weights.numpy().astype(np.float64))
    order = np.argsort(-weights, axis=1, kind="stable")[:, :MAX_MODES]
    rows = np.arange(len(agents))[:, None]
    means: Floats = mixture.means.numpy()[rows, order] + mixture.origin.numpy()[:, None, None]
    covariances = mixture.covariances.numpy()[rows, order]
    triangles: Floats = np.empty((*covariances.shape[:-2], 3))
    for place, (row, column) in enumerate(TRIANGLE):
        triangles[..., place] = covariances[..., row, column]
    weights = weights[rows, order].round(_WEIGHT_DECIMALS)
    means, triangles = means.round(_POSITION_DECIMALS) + 0.0, _rounded(triangles)
    for place, (agent, count) in enumerate(zip(agents, counts.tolist(), strict=True)):
        agent.MergeFromString(
            packed_doubles(_WEIGHTS, weights[place, :count])
            + packed_doubles(_MEANS, means[place, :count])
            + packed_doubles(_COVARIANCES, triangles[place, :count])
        )


def _rounded(triangles: Floats) -> Floats:
    """Return rounded covariances [..., 3], which stay covariances."""
    least = 10.0**-_COVARIANCE_DECIMALS
    rounded: Floats = triangles.round(_COVARIANCE_DECIMALS) + 0.0
    rounded[..., [0, 2]] = np.maximum(rounded[..., [0, 2]], least)
    most = np.sqrt(rounded[..., 0] * rounded[..., 2])
    rounded[..., 1] = np.where(np.abs(rounded[..., 1]) < most, rounded[..., 1], 0.0)
    return rounded
