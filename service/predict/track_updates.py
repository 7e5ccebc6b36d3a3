"""Exchange of a call with the track memory: what is stored, and what the response tells of it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeAlias

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.forecaster import Context, Forecaster
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


def observation_updates(agents: Agents, models: tuple[Forecaster, Forecaster]) -> list[TrackUpdate]:
    """Return all observations of a call, for the recall before the forecast: one update per valid agent.

    Args:
        agents: the agents of the call.
        models: the requested model and the fallback.
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


def unambiguous(agents: Agents, own: Sequence[TrackUpdate]) -> list[TrackUpdate]:
    """Return the updates for the track memory: those of agents that share their id with no other."""
    return [
        one for index, one in zip(agents.valid.tolist(), own, strict=True) if index not in agents.duplicates
    ]


def with_histories(agents: Agents, own: Sequence[TrackUpdate], histories: Mapping[str, bytes]) -> Agents:
    """Return the agents with their histories from the track memory.

    Args:
        agents: the agents of the call.
        own: the call's own observations, from ``observation_updates``.
        histories: the histories by id, the call's own observations included; empty if the memory did not
            respond.
    """
    if not own or not histories:
        return agents
    packed = [histories.get(one.agent_id) or one.observations for one in own]
    return replace(agents, observations=unpack_observations(packed))


def forecast_updates(plan: Plan, remembered: bool) -> list[TrackUpdate]:
    """Return what a call adds to the track memory: forecasts, except blind ones, and newest observations.

    Args:
        plan: the plan of the call, whose groups have run.
        remembered: flag for observations that were stored before, when histories were recalled.
    """
    agents = plan.agents
    made: dict[int, tuple[str, bytes]] = {}
    if plan.options.context is not Context.BLIND:
        for group in plan.groups:
            if group.outcome is None or not group.drafts:
                continue
            name = group.job.forecaster.info.full_name
            for draft, forecast in zip(group.drafts, pack_forecasts(group.outcome.mixture), strict=True):
                made[draft.index] = name, forecast
    if agents.observations is None:
        return []
    packed = pack_observations(agents.observations, newest_only=True)
    added = []
    for index, kind, newest in zip(agents.valid.tolist(), agents.types, packed, strict=True):
        series, forecast = made.get(index, ("", b""))
        if index in agents.duplicates or (remembered and not forecast):
            continue
        observations = b"" if remembered else newest
        steps = plan.options.steps if forecast else 0
        added.append(TrackUpdate(agents.ids[index], AGENT_TYPES[kind], observations, series, forecast, steps))
    return added


def report(response: pb.PredictResponse, recalled: TrackingResult | None, stored: TrackingResult) -> None:
    """Add what the track memory responded to the response of the call.

    Args:
        response: the response of the call.
        recalled: what it responded before the forecasts, if histories were recalled.
        stored: what it responded when the forecasts were stored.
    """
    first = recalled or stored
    response.tracking = max(first.status, stored.status, key=_SEVERITY.index)
    response.timing.tracking = stored.seconds + (recalled.seconds if recalled is not None else 0.0)
    for forecast in response.forecasts:
        agent_id = forecast.agent_id
        if response.tracking == consistency_pb.TRACKING_STATUS_UNAVAILABLE:
            forecast.tracking = response.tracking
        elif agent_id in first.agents:
            forecast.tracking = _status(first.agents[agent_id], stored.agents.get(agent_id))
        latest = first.latest.get(agent_id)
        if latest is not None and latest.model == forecast.model:
            forecast.consistency.CopyFrom(latest)


def _status(first: "Status", second: "Status | None") -> "Status":
    """Return the status of an agent, which may have been lost between the two exchanges of a call."""
    lost = (consistency_pb.TRACKING_STATUS_NEW, consistency_pb.TRACKING_STATUS_RESET)
    if first == consistency_pb.TRACKING_STATUS_OK and second in lost:
        return consistency_pb.TRACKING_STATUS_RESET
    return first
