"""Memory of one scene: a state machine that applies the calls of the scene in order.

The state depends only on the calls and their order. The memory in this process and the one in Redis, whose
log orders the calls of all servers, are therefore equal.
"""

import asyncio
from bisect import bisect_left, insort
from collections.abc import Sequence
from dataclasses import dataclass, field

from model.scenes.resample import TIME_TOLERANCE
from service.tracking.store.base import LATENESS, WINDOW, TrackStatus
from service.tracking.store.log_entry import LogEntry
from service.tracking.store.observation_buffer import ObservationBuffer
from service.tracking.store.track import Instant, Track

MAX_AGENTS = 4096
"""Agents per scene."""
MAX_CALLS = 512
"""Calls per scene whose times are kept."""


@dataclass
class ApplyResult:
    """Result of one call."""

    track_statuses: list[TrackStatus] = field(default_factory=list)
    """Status of each agent of the call."""
    histories: list[bytes] = field(default_factory=list)
    """History of each agent of the call, if requested."""
    instants: list[Instant] = field(default_factory=list)
    """Instants to report."""
    behind_s: float = 0.0
    """Seconds that this call is before the scene's newest one; 0 for a repeated call."""
    restarted: bool = False
    """True if the scene was cleared because its newest call was too far ahead of this one."""


class SceneMemory:
    """Tracks of the agents that were observed within the window of the scene's newest call."""

    def __init__(self) -> None:
        self._newest = float("-inf")
        self._calls: list[float] = []
        """Times of the calls within the window, s, ascending."""
        self._tracks: dict[str, Track] = {}

    def __len__(self) -> int:
        """Return the number of agents."""
        return len(self._tracks)

    @property
    def cut(self) -> float:
        """Time before which everything is dropped, s."""
        return self._newest - WINDOW

    def apply(self, entry: LogEntry, history_s: float | None = None) -> ApplyResult:
        """Store the updates of a call.

        Args:
            entry: the call.
            history_s: seconds of history to return; None: no histories.
        """
        result = ApplyResult()
        behind_s = self._newest - entry.time
        repeated = self._note_call(entry.time)
        cleared: Sequence[str] = ()
        if entry.time < self._newest - LATENESS - TIME_TOLERANCE:
            result.restarted = True
            cleared = tuple(self._tracks)
            self._tracks.clear()
            self._calls = [entry.time]
            self._newest = entry.time
        self._newest = max(self._newest, entry.time)
        self._drop_tracks_before(self.cut)
        for update in entry.updates:
            track = self._tracks.get(update.agent_id)
            observations = ObservationBuffer.parse(update.observations)
            status = TrackStatus.NEW if track is None else TrackStatus.KEPT
            if update.agent_id in cleared:
                status = TrackStatus.RESET
            if track is not None and not track.fits(observations):
                track, status = None, TrackStatus.RESET
            if track is None:
                track = self._tracks[update.agent_id] = Track(update.agent_type)
                self._make_room()
            if track.agent_type != update.agent_type:
                status = TrackStatus.RETYPED
                if entry.time == self._newest:
                    track.agent_type = update.agent_type
            result.track_statuses.append(status)
            result.instants.extend(track.apply(update, observations, entry.time, self.cut))
            if history_s is not None:
                result.histories.append(track.history(entry.time, history_s))
        # A repeated call says the same; one that contradicts is another call, by a clock that was set back
        if behind_s > TIME_TOLERANCE and (not repeated or TrackStatus.RESET in result.track_statuses):
            result.behind_s = behind_s
        return result

    async def snapshot(self, window: float, agent_id: str | None = None) -> tuple[list[str], list[Instant]]:
        """Return the ids of the known agents, and the set of each of their observations for every model.

        Each agent's part is consistent. Other tasks run between agents, since there may be many.

        Args:
            window: seconds before an agent's newest observation.
            agent_id: the agent; None: all.
        """
        ids: list[str] = []
        instants: list[Instant] = []
        for one in list(self._tracks) if agent_id is None else [agent_id]:
            track = self._tracks.get(one)
            if track is not None:
                ids.append(one)
                instants.extend(track.snapshot(one, window))
                await asyncio.sleep(0)
        return ids, instants

    def _note_call(self, time: float) -> bool:
        """Store the time of a call, and return whether there was one of that time."""
        calls = self._calls
        del calls[: max(bisect_left(calls, self.cut), len(calls) - MAX_CALLS)]
        at = bisect_left(calls, time - TIME_TOLERANCE)
        if at < len(calls) and calls[at] <= time + TIME_TOLERANCE:
            return True
        insort(calls, time)
        return False

    def _drop_tracks_before(self, cut: float) -> None:
        dropped = [agent_id for agent_id, track in self._tracks.items() if track.newest < cut]
        for agent_id in dropped:
            del self._tracks[agent_id]

    def _make_room(self) -> None:
        """Drop the oldest track of a full scene: a client with ever new ids must not fill the memory."""
        if len(self._tracks) > MAX_AGENTS:
            del self._tracks[next(iter(self._tracks))]
