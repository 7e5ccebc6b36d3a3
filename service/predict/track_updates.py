"""What of a call goes into the track memory, and what comes out of it for a call."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.forecaster import Context, Forecaster
from service.predict.encode import Result
from service.predict.plan import Plan
from service.predict.request import Agents
from service.tracking.store.base import TrackUpdate
from service.tracking.store.records import AGENT_TYPES, pack_forecasts, pack_observations, unpack_observations
from service.tracking.tracker import TrackingResult

Status: TypeAlias = "consistency_pb.TrackingStatus.ValueType"
_SEVERITY = (
    consistency_pb.TRACKING_STATUS_UNSPECIFIED,
    consistency_pb.TRACKING_STATUS_OK,
    consistency_pb.TRACKING_STATUS_NEW,
    consistency_pb.TRACKING_STATUS_RESET,
    consistency_pb.TRACKING_STATUS_UNAVAILABLE,
)


def observed(agents: Agents, models: tuple[Forecaster, Forecaster]) -> list[TrackUpdate]:
    """All that a call says of its agents, before they are forecast.

    Args:
        agents: of the call.
        models: the one that is asked for, and the fallback.
    """
    forecaster, fallback = models
    if agents.observations is None:
        return []
    packed = pack_observations(agents.observations, newest_only=False)
    return [
        TrackUpdate(
            agents.ids[index],
            AGENT_TYPES[kind],
            observations,
            (forecaster if kind in forecaster.info.agent_types else fallback).info.full_name,
        )
        for index, kind, observations in zip(agents.valid.tolist(), agents.types, packed, strict=True)
    ]


def with_histories(agents: Agents, own: Sequence[TrackUpdate], histories: Mapping[str, bytes]) -> Agents:
    """Agents with what the memory recalls of them.

    Args:
        agents: of the call.
        own: what the call says of them, of ``observed``.
        histories: by id, each with the call's own observations; empty where the memory did not answer.
    """
    if not own or not histories:
        return agents
    packed = [histories.get(one.agent_id) or one.observations for one in own]
    return replace(agents, observations=unpack_observations(packed))


def sightings(plan: Plan, results: Sequence[Result], remembered: bool) -> list[TrackUpdate]:
    """What a call brings: forecasts but for blind ones, and each agent's newest observation, unless it is
    remembered already.

    Args:
        plan: of the call.
        results: the forecasts that were made.
        remembered: whether the observations were, when histories were recalled.
    """
    agents = plan.agents
    made: dict[int, tuple[str, bytes]] = {}
    if plan.options.context is not Context.BLIND:
        for result in results:
            for draft, forecast in zip(result.drafts, pack_forecasts(result.mixture), strict=True):
                if draft.forecaster is not None:
                    made[draft.index] = draft.forecaster.info.full_name, forecast
    if agents.observations is None:
        return []
    packed = pack_observations(agents.observations, newest_only=True)
    brought = []
    for index, kind, newest in zip(agents.valid.tolist(), agents.types, packed, strict=True):
        series, forecast = made.get(index, ("", b""))
        if remembered and not forecast:
            continue
        observations = b"" if remembered else newest
        steps = plan.options.steps if forecast else 0
        brought.append(
            TrackUpdate(agents.ids[index], AGENT_TYPES[kind], observations, series, forecast, steps)
        )
    return brought


def report(response: pb.PredictResponse, before: TrackingResult | None, after: TrackingResult) -> None:
    """Puts what the memory said into the answer.

    Args:
        response: the answer.
        before: of the time before the forecasts, if histories were recalled.
        after: of the time when they were brought.
    """
    first = before or after
    response.tracking = max(first.status, after.status, key=_SEVERITY.index)
    response.timing.tracking = after.seconds + (before.seconds if before is not None else 0.0)
    for forecast in response.forecasts:
        agent_id = forecast.agent_id
        if response.tracking == consistency_pb.TRACKING_STATUS_UNAVAILABLE:
            forecast.tracking = response.tracking
        elif agent_id in first.agents:
            forecast.tracking = _of_agent(first.agents[agent_id], after.agents.get(agent_id))
        latest = first.latest.get(agent_id)
        if latest is not None and latest.model == forecast.model:
            forecast.consistency.CopyFrom(latest)


def _of_agent(first: "Status", after: "Status | None") -> "Status":
    """What became of an agent, which may have been lost between the two times that a call asked."""
    gone = (consistency_pb.TRACKING_STATUS_NEW, consistency_pb.TRACKING_STATUS_RESET)
    if first == consistency_pb.TRACKING_STATUS_OK and after in gone:
        return consistency_pb.TRACKING_STATUS_RESET
    return first
