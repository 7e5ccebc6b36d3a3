"""The track memory as the calls of Predict use it: never in the way of a forecast."""

import asyncio
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from time import perf_counter

from cab.forecast.v1 import consistency_service_pb2 as pb
from service.tracking.aggregates import Sums
from service.tracking.messages import instant_messages
from service.tracking.metrics import figures
from service.tracking.model_references import ModelReferences
from service.tracking.statuses import OF_AGENT, OF_SCENE
from service.tracking.store.base import Recalled, Sighting, StoreError, TrackStore
from service.tracking.store.guard import Guard

PATIENCE = 2.0
"""s that those who do not forecast wait for the track memory."""
_ASIDE = 0.002
"""s after which what calls settled is counted."""


@dataclass
class Tracked:
    """What the memory said in one call."""

    status: "pb.TrackingStatus.ValueType" = pb.TRACKING_STATUS_UNAVAILABLE
    agents: "dict[str, pb.TrackingStatus.ValueType]" = field(default_factory=dict)
    """By id; empty where the memory did not answer."""
    histories: dict[str, bytes] = field(default_factory=dict)
    """By id, if they were asked for."""
    latest: dict[str, pb.InstantConsistency] = field(default_factory=dict)
    """By id: the newest observation, if it was asked for."""
    seconds: float = 0.0
    """s that the call waited for it."""

    @property
    def answered(self) -> bool:
        """Whether there was an answer in time."""
        return self.status != pb.TRACKING_STATUS_UNAVAILABLE


class Tracker:
    """Remembers what calls bring, and counts what it finds out.

    Args:
        store: the memory.
        guard: of the calls to it that forecasts wait for.
        asking: of the others.
        budget: s that a call waits for the memory.
        references: references to models.
    """

    def __init__(
        self,
        store: TrackStore,
        guard: Guard,
        asking: Guard,
        budget: float,
        references: ModelReferences,
    ) -> None:
        self._sums = Sums()
        self._store = store
        self._guard = guard
        self._asking = asking
        self._budget = budget
        self._references = references
        self._telling: dict[str, asyncio.Task[None]] = {}
        """The last of each scene that is told of something."""
        self._due: list[tuple[str, Recalled]] = []
        """What is still to be counted."""

    def sums(self) -> Sums:
        """What was settled over the process's life, by model."""
        self._count()
        return self._sums

    async def exchange(
        self,
        scene_id: str,
        time: float,
        sightings: Sequence[Sighting],
        patience: float,
        recall: float | None = None,
        latest: bool = False,
    ) -> Tracked:
        """Remembers what a call brings; says so where the memory does not answer in time.

        Args:
            scene_id: of the call.
            time: of the call, s.
            sightings: its agents.
            patience: s that the call has left; what waits for the memory must not cost it its forecasts.
            recall: s of history that are wanted; None: none is.
            latest: whether the consistency at the newest observations is wanted.
        """
        started = perf_counter()
        tracked = Tracked()

        try:
            recalled = await self._guard.run(
                "exchange",
                lambda: self._store.exchange(scene_id, time, sightings, recall),
                self._budget,
                patience_s=max(patience, 0.0),
                late=lambda recalled: self._put_off(scene_id, recalled),
            )
        except StoreError:
            tracked.seconds = perf_counter() - started
            return tracked
        tracked.status = OF_SCENE[recalled.event]
        ids = [one.agent_id for one in sightings]
        tracked.agents = {one: OF_AGENT[fate] for one, fate in zip(ids, recalled.fates, strict=True)}
        tracked.histories = dict(zip(ids, recalled.histories, strict=False))
        if latest:
            messages = self._take(scene_id, recalled, latest)
            tracked.latest = _newest(sightings, recalled.instants.series, messages)
        else:
            self._put_off(scene_id, recalled)
        tracked.seconds = perf_counter() - started
        return tracked

    def _put_off(self, scene_id: str, recalled: Recalled) -> None:
        """Has it counted when the answer is out, which need not wait for it."""
        if not recalled.instants.series:
            return
        if not self._due:
            asyncio.get_running_loop().call_later(_ASIDE, self._count)
        self._due.append((scene_id, recalled))

    def _count(self) -> None:
        due, self._due = self._due, []
        for scene_id, recalled in due:
            self._take(scene_id, recalled, latest=False)

    def _take(self, scene_id: str, recalled: Recalled, latest: bool) -> list[pb.InstantConsistency]:
        """Counts what was settled and tells those who watch; messages of all instants, if they are wanted."""
        instants = recalled.instants
        if not instants.series:
            return []
        found = figures(instants.packed)
        if found.newly.any():
            self._sums.add(found, instants.series, newly_only=True)
        if not (latest or recalled.watched):
            return []
        messages = instant_messages(found, instants.agent_ids, instants.series, self._references)
        if recalled.watched:
            self._tell(scene_id, [message.SerializeToString() for message in messages])
        return messages

    def _tell(self, scene_id: str, events: Sequence[bytes]) -> None:
        """Tells those who watch, after what they were told before; no call waits for it."""
        telling = asyncio.create_task(self._publish(scene_id, events, self._telling.get(scene_id)))
        self._telling[scene_id] = telling
        telling.add_done_callback(lambda told: self._told(scene_id, told))

    async def _publish(
        self, scene_id: str, events: Sequence[bytes], before: "asyncio.Task[None] | None"
    ) -> None:
        if before is not None:
            await asyncio.wait((before,))
        with suppress(StoreError):  # the guard has counted it
            await self._asking.run("publish", lambda: self._store.publish(scene_id, events), PATIENCE)

    def _told(self, scene_id: str, told: "asyncio.Task[None]") -> None:
        if self._telling.get(scene_id) is told:
            del self._telling[scene_id]


def _newest(
    sightings: Sequence[Sighting], series: Sequence[str], messages: Sequence[pb.InstantConsistency]
) -> dict[str, pb.InstantConsistency]:
    """Of each agent the last instant of the series that the call is about.

    Args:
        sightings: what the call brought.
        series: of each message.
        messages: of all that the memory told.
    """
    asked = {one.agent_id: one.series for one in sightings}
    newest: dict[str, pb.InstantConsistency] = {}
    for name, message in zip(series, messages, strict=True):
        known = newest.get(message.agent_id)
        if asked.get(message.agent_id) == name and (known is None or message.time > known.time):
            newest[message.agent_id] = message
    return newest
