"""Track memory of the Predict calls: it never delays a forecast."""

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from time import perf_counter

from cab.forecast.v1 import consistency_service_pb2 as pb
from service.tracking.aggregates import Aggregates
from service.tracking.messages import AGENT_TRACKING, SCENE_TRACKING, instant_messages
from service.tracking.metrics import instant_metrics
from service.tracking.model_references import ModelReferences
from service.tracking.store.base import (
    ExchangeResult,
    Instants,
    StoreError,
    TrackStatus,
    TrackStore,
    TrackUpdate,
)
from service.tracking.store.guard import Guard

STORE_TIMEOUT = 2.0
"""Seconds that calls other than Predict wait for the track memory."""
_AGGREGATION_DELAY = 0.002
"""Seconds until the sets that a call settled are aggregated; the response goes out first."""


@dataclass
class TrackingResult:
    """Result of one exchange with the track memory."""

    status: "pb.TrackingStatus.ValueType" = pb.TRACKING_STATUS_UNAVAILABLE
    agents: "dict[str, pb.TrackingStatus.ValueType]" = field(default_factory=dict)
    """Status by agent id; empty if the memory was unavailable."""
    retyped: frozenset[str] = frozenset()
    """Ids of agents whose tracks were of another type."""
    behind_s: float = 0.0
    """Seconds that the call is before the scene's newest one; 0 for a repeated call."""
    histories: dict[str, bytes] = field(default_factory=dict)
    """History by agent id, if requested."""
    latest: dict[str, pb.InstantConsistency] = field(default_factory=dict)
    """Consistency at the newest observation by agent id, if requested."""
    instants: Instants = field(default_factory=Instants)
    """What ``latest`` is made of."""
    seconds: float = 0.0
    """Seconds that the call waited for the memory."""

    @property
    def answered(self) -> bool:
        """True if the memory answered in time."""
        return self.status != pb.TRACKING_STATUS_UNAVAILABLE


class Tracker:
    """Stores the updates of Predict calls and aggregates the sets that they settle.

    Args:
        store: the track memory.
        guard: guard of the exchanges, which forecasts wait for.
        query_guard: guard of all other calls to the store.
        budget: seconds that an exchange may take.
        references: references to models.
    """

    def __init__(
        self,
        store: TrackStore,
        guard: Guard,
        query_guard: Guard,
        budget: float,
        references: ModelReferences,
    ) -> None:
        self.aggregates = Aggregates()
        """Aggregates over the lifetime of the process, without the pending sets."""
        self._store = store
        self._guard = guard
        self._query_guard = query_guard
        self._budget = budget
        self._references = references
        self._publishing: dict[str, asyncio.Task[None]] = {}
        """Last publication of each scene."""
        self._pending: list[tuple[str, ExchangeResult]] = []
        """Results to aggregate, with the ids of their scenes."""

    def aggregate_pending(self) -> None:
        """Aggregate what earlier calls left pending."""
        pending, self._pending = self._pending, []
        for scene_id, result in pending:
            self._aggregate(scene_id, result, latest=False)

    async def exchange(
        self,
        scene_id: str,
        time: float,
        updates: Sequence[TrackUpdate],
        time_left: float,
        history_s: float | None = None,
        latest: bool = False,
    ) -> TrackingResult:
        """Store the updates of a call.

        Store failures do not raise: the status of the result is UNAVAILABLE.

        Args:
            scene_id: the scene.
            time: time of the call, s.
            updates: updates of its agents.
            time_left: seconds that the call can wait without missing its deadline.
            history_s: seconds of history to return; None: no histories.
            latest: whether to return the consistency at the newest observations.
        """
        started = perf_counter()
        tracking = TrackingResult()

        try:
            result = await self._guard.run(
                "exchange",
                lambda: self._store.exchange(scene_id, time, updates, history_s),
                self._budget,
                time_left_s=max(time_left, 0.0),
                late=lambda result: self._aggregate_later(scene_id, result),
            )
        except StoreError:
            tracking.seconds = perf_counter() - started
            return tracking
        tracking.status = SCENE_TRACKING[result.scene_status]
        ids = [update.agent_id for update in updates]
        tracking.agents = {
            agent_id: AGENT_TRACKING[status]
            for agent_id, status in zip(ids, result.track_statuses, strict=True)
        }
        tracking.retyped = frozenset(
            agent_id
            for agent_id, status in zip(ids, result.track_statuses, strict=True)
            if status is TrackStatus.RETYPED
        )
        tracking.behind_s = result.behind_s
        tracking.histories = dict(zip(ids, result.histories, strict=False))
        tracking.instants = result.instants
        if latest:
            messages = self._aggregate(scene_id, result, latest)
            requested = {update.agent_id: update.model for update in updates}
            tracking.latest = _newest(requested, result.instants.models, messages)
        else:
            self._aggregate_later(scene_id, result)
        tracking.seconds = perf_counter() - started
        return tracking

    def _aggregate_later(self, scene_id: str, result: ExchangeResult) -> None:
        """Aggregate a result after the response has gone out."""
        if not result.instants.models:
            return
        if not self._pending:
            asyncio.get_running_loop().call_later(_AGGREGATION_DELAY, self.aggregate_pending)
        self._pending.append((scene_id, result))

    def _aggregate(self, scene_id: str, result: ExchangeResult, latest: bool) -> list[pb.InstantConsistency]:
        """Aggregate the newly settled sets and publish all instants to the watchers.

        Returns:
            Messages of all instants, if ``latest`` or the watchers need them.
        """
        instants = result.instants
        if not instants.models:
            return []
        metrics = instant_metrics(instants.packed)
        if metrics.newly.any():
            self.aggregates.add(metrics, instants.models, newly_only=True)
        if not (latest or result.watched):
            return []
        messages = instant_messages(metrics, instants.agent_ids, instants.models, self._references)
        if result.watched:
            self._publish_later(scene_id, [message.SerializeToString() for message in messages])
        return messages

    def _publish_later(self, scene_id: str, events: Sequence[bytes]) -> None:
        """Publish events in the background, after the scene's earlier ones."""
        task = asyncio.create_task(self._publish(scene_id, events, self._publishing.get(scene_id)))
        self._publishing[scene_id] = task
        task.add_done_callback(lambda task: self._published(scene_id, task))

    async def _publish(
        self, scene_id: str, events: Sequence[bytes], previous: "asyncio.Task[None] | None"
    ) -> None:
        if previous is not None:
            await asyncio.wait((previous,))
        with suppress(StoreError):  # the guard counts and logs it
            await self._query_guard.run(
                "publish", lambda: self._store.publish(scene_id, events), STORE_TIMEOUT
            )

    def _published(self, scene_id: str, task: "asyncio.Task[None]") -> None:
        if self._publishing.get(scene_id) is task:
            del self._publishing[scene_id]


def _newest(
    requested: Mapping[str, str], models: Sequence[str], messages: Sequence[pb.InstantConsistency]
) -> dict[str, pb.InstantConsistency]:
    """Return the newest instant of each agent, for its model.

    Args:
        requested: the model of each agent.
        models: [P], the model of each message.
        messages: [P].
    """
    newest: dict[str, pb.InstantConsistency] = {}
    for model, message in zip(models, messages, strict=True):
        known = newest.get(message.agent_id)
        if requested.get(message.agent_id) == model and (known is None or message.time > known.time):
            newest[message.agent_id] = message
    return newest
