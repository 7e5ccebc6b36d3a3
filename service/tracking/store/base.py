"""What a track memory does, whichever it is."""

from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NamedTuple

WINDOW = 10.5
"""s before a scene's newest call that are remembered: 6.1 s of forecasts, 2 s until a set is settled, 2 s for
calls that come late, and some room."""
AGE_TOLERANCE = 0.09
"""s that a forecast may have been made off its lag of k · 0.5 s: at 10 Hz none stands in for a
lost frame's."""
LATENESS = 2.0
"""s before a scene's newest call that another may come. An earlier one is of a clock that was put back, or of
a recording that is played again, and the scene begins anew."""
SETTLE_AFTER = LATENESS
"""s after which a complete set is final though forecasts in it were made off their lags."""
MAX_FORECASTS = 150
"""Forecasts of one model that are remembered of an agent, 14 a second over the window; the oldest go."""
MAX_SERIES = 15
"""Models whose forecasts are remembered of one agent; those of others are not."""


class StoreError(Exception):
    """The track memory did not answer; the text says why."""


class Fate(IntEnum):
    """What became of the memory of an agent in a call."""

    KEPT = 0
    NEW = 1
    """There was none."""
    RESET = 2
    """It did not fit and was forgotten; what the call brings is its beginning."""


class Sighting(NamedTuple):
    """What one call brings of one agent."""

    agent_id: str
    kind: bytes
    """One of ``records.KINDS``."""
    observations: bytes
    """``records.pack_observations``; may be empty."""
    series: str = ""
    """Which model made the forecast, name@version, or was asked for; empty: none."""
    forecast: bytes = b""
    """``records.pack_forecasts``; empty: none was made."""
    steps: int = 0
    """Of the forecast."""


class Event(Enum):
    """What became of the memory of a scene in a call."""

    KEPT = "kept"
    BEGUN = "begun"
    """There was none."""
    LOST = "lost"
    """The one that this server knew is gone; what the call brings may be the beginning of another."""


@dataclass(frozen=True)
class Instants:
    """Observations, each with one model's forecasts for it; P of them."""

    packed: bytes = b""
    """[P] of ``records.INSTANT``."""
    agent_ids: Sequence[str] = ()
    """[P]."""
    series: Sequence[str] = ()
    """[P], whose forecasts."""


@dataclass(frozen=True)
class Recalled:
    """What a store answers to one call."""

    event: Event
    fates: Sequence[Fate]
    """Of each agent, in the call's order."""
    histories: Sequence[bytes]
    """Of each agent, if they were asked for: observations up to the call's time, the call's own included."""
    instants: Instants
    """Of each agent with a series its newest observation in the call, and what else the call settled."""
    watched: bool
    """Whether anybody watches the scene, on whichever server."""


@dataclass(frozen=True)
class Remembered:
    """All that is remembered of some agents of a scene."""

    agent_ids: Sequence[str]
    """The agents."""
    instants: Instants
    """Each observation once for each series of its agent, by ascending time within an agent."""


class TrackStore(ABC):
    """The memory. A scene is remembered until there was no call of it for the store's expiry; of its agents
    what the calls of the last ``WINDOW`` brought."""

    @abstractmethod
    async def exchange(
        self, scene_id: str, time: float, sightings: Sequence[Sighting], recall: float | None = None
    ) -> Recalled:
        """Remembers what a call brings, and tells what it completes; atomic, and one round trip.

        Of one time (to ``TIME_TOLERANCE``) and agent what came first is kept, so that a call may come twice.

        Args:
            scene_id: whose agents these are.
            time: of the call, s; the forecasts' as well.
            sightings: each agent once.
            recall: s before ``time`` from which on histories are told; None: not at all.

        Raises:
            StoreError: there is no answer; what was to be remembered may be or not.
        """

    @abstractmethod
    async def read(self, scene_id: str, window: float, agent_id: str | None = None) -> Remembered:
        """What is remembered of one agent, or of all.

        Args:
            scene_id: whose.
            window: s before an agent's newest observation from which on observations are told.
            agent_id: which; None: all.

        Raises:
            StoreError: there is no answer.
        """

    @abstractmethod
    async def reset(self, scene_id: str) -> int:
        """Forgets a scene; how many agents it had.

        Raises:
            StoreError: there is no answer; it may have been forgotten.
        """

    @abstractmethod
    async def publish(self, scene_id: str, events: Sequence[bytes]) -> None:
        """Tells those who watch a scene.

        Args:
            scene_id: the scene.
            events: in order.

        Raises:
            StoreError: it is not known whether they were told.
        """

    @abstractmethod
    def watch(self, scene_id: str) -> "AsyncGenerator[tuple[Sequence[bytes], int], None]":
        """What is published of a scene from now on, on any server of this store: events, oldest first, and
        how many this reader has missed before them. None at first, as soon as it watches. Ends when closed.

        Raises:
            StoreError: the store cannot be reached any more.
        """

    @abstractmethod
    async def close(self) -> None:
        """Frees what is held."""
