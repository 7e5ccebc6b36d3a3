"""One scene's memory: a state that the calls of the scene change one after the other.

It depends on nothing but these calls and their order. So the memory in this process and the one in Redis,
where the calls are written down in one order for all servers, are the same.
"""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field

from model.scenes.resample import TIME_TOLERANCE
from service.tracking.store.base import LATENESS, WINDOW, Fate
from service.tracking.store.log_entry import Entry
from service.tracking.store.observation_buffer import Sighted
from service.tracking.store.track import Instant, Track

MAX_AGENTS = 4096
"""Of a scene."""


@dataclass
class Outcome:
    """What one call led to."""

    fates: list[Fate] = field(default_factory=list)
    """Of each of its agents."""
    histories: list[bytes] = field(default_factory=list)
    """Of each of its agents, if they were asked for."""
    instants: list[Instant] = field(default_factory=list)
    """What there is to be told."""
    restarted: bool = False
    """Whether all that came before was forgotten: its clock was ahead."""


class SceneMemory:
    """The agents of a scene, each as long as it was seen within the window of the scene's newest call."""

    def __init__(self) -> None:
        self._newest = float("-inf")
        self._tracks: dict[str, Track] = {}

    def __len__(self) -> int:
        """Agents."""
        return len(self._tracks)

    @property
    def cut(self) -> float:
        """s; of what was before it nothing is remembered."""
        return self._newest - WINDOW

    def apply(self, entry: Entry, recall: float | None = None) -> Outcome:
        """Remembers what a call brings.

        Args:
            entry: the call.
            recall: s of history that are wanted; None: none is.
        """
        outcome = Outcome()
        gone: Sequence[str] = ()
        if entry.time < self._newest - LATENESS - TIME_TOLERANCE:
            outcome.restarted = True
            gone = tuple(self._tracks)
            self._tracks.clear()
            self._newest = entry.time
        self._newest = max(self._newest, entry.time)
        self._forget(self.cut)
        for sighting in entry.sightings:
            track = self._tracks.get(sighting.agent_id)
            given = Sighted.parse(sighting.observations)
            fate = Fate.RESET if sighting.agent_id in gone else Fate.NEW if track is None else Fate.KEPT
            if track is not None and not track.fits(sighting.kind, given):
                track, fate = None, Fate.RESET
            if track is None:
                track = self._tracks[sighting.agent_id] = Track(sighting.kind)
                self._make_room()
            outcome.fates.append(fate)
            outcome.instants.extend(track.exchange(sighting, given, entry.time, self.cut))
            if recall is not None:
                outcome.histories.append(track.history(entry.time, recall))
        return outcome

    async def everything(self, window: float, agent_id: str | None = None) -> tuple[list[str], list[Instant]]:
        """Ids of all agents, or of one if it is remembered, and each observation's set of every series.

        Each agent is as it is at one time; between them others get their turn, for there may be many.

        Args:
            window: s before an agent's newest observation.
            agent_id: which; None: all.
        """
        ids: list[str] = []
        instants: list[Instant] = []
        for one in list(self._tracks) if agent_id is None else [agent_id]:
            track = self._tracks.get(one)
            if track is not None:
                ids.append(one)
                instants.extend(track.everything(one, window))
                await asyncio.sleep(0)
        return ids, instants

    def _forget(self, cut: float) -> None:
        gone = [agent_id for agent_id, track in self._tracks.items() if track.newest < cut]
        for agent_id in gone:
            del self._tracks[agent_id]

    def _make_room(self) -> None:
        """Who takes new ids for the same agents all the time must not fill the memory."""
        if len(self._tracks) > MAX_AGENTS:
            del self._tracks[next(iter(self._tracks))]  # the one that is known for the longest time
