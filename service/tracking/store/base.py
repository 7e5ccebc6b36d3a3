"""Interface of the track memory, which every store implements."""

from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import NamedTuple

WINDOW = 10.5
"""Seconds before a scene's newest call that are kept: 6.1 s of forecasts, 2 s until a set settles, 2 s for
late calls, and a margin."""
AGE_TOLERANCE = 0.09
"""Seconds between the time of a forecast and its lag of k · 0.5 s, at most. At 10 Hz, no forecast replaces
that of a lost frame."""
LATENESS = 2.0
"""Seconds that a call may be older than a scene's newest one. An older call means that the clock was set back
or a recording was restarted, and the scene starts again."""
SETTLE_AFTER = LATENESS
"""Seconds after which a complete set settles even if some of its forecasts are off their lags."""
MAX_FORECASTS = 150
"""Forecasts of one model that are kept per agent (14 per second over the window); the oldest are dropped."""
MAX_MODELS = 15
"""Models whose forecasts are kept per agent; forecasts of further models are dropped."""


class StoreError(Exception):
    """Failure of the track memory; the text gives the reason."""


class TrackStatus(IntEnum):
    """Status of an agent's track in a call."""

    KEPT = 0
    NEW = 1
    """The agent had no track."""
    RESET = 2
    """The track contradicted the call and was replaced by a new one."""
    RETYPED = 3
    """The track was kept, but the call gives the agent another type."""


class TrackUpdate(NamedTuple):
    """Observations and forecast that one call adds to one agent's track."""

    agent_id: str
    agent_type: bytes
    """One of ``records.AGENT_TYPES``."""
    observations: bytes
    """``records.pack_observations``; may be empty."""
    model: str = ""
    """Model that made the forecast or was requested, ``name@version``; empty: none."""
    forecast: bytes = b""
    """``records.pack_forecasts``; empty: no forecast was made."""
    steps: int = 0
    """Steps of the forecast."""


class SceneStatus(Enum):
    """Status of a scene's memory in a call."""

    KEPT = "kept"
    NEW = "new"
    """The scene was unknown."""
    LOST = "lost"
    """The memory that this server knew is gone; the call may have started a new one."""


@dataclass(frozen=True)
class Instants:
    """P observations, each with the forecasts that one model made for it."""

    packed: bytes = b""
    """[P] of ``records.INSTANT``."""
    agent_ids: Sequence[str] = ()
    """[P]."""
    models: Sequence[str] = ()
    """[P], ``name@version``."""


@dataclass(frozen=True)
class ExchangeResult:
    """Response of a store to one call."""

    scene_status: SceneStatus
    track_statuses: Sequence[TrackStatus]
    """Status of each agent, in the order of the call."""
    histories: Sequence[bytes]
    """Observations of each agent up to the time of the call, including its own; empty if not requested."""
    instants: Instants
    """Newest observation of each agent with a model, and all instants that the call settled."""
    watched: bool
    """True if the scene has a watcher, on any server."""
    behind_s: float = 0.0
    """Seconds that the call is before the scene's newest one; 0 for a repeated call."""


@dataclass(frozen=True)
class SceneSnapshot:
    """Everything the memory holds about some agents of a scene."""

    agent_ids: Sequence[str]
    instants: Instants
    """Each observation once per model of its agent, ascending by time within an agent."""


class TrackStore(ABC):
    """Track memory.

    A scene expires after a time without calls. Its agents keep what the calls of the last ``WINDOW`` seconds
    brought.
    """

    @abstractmethod
    async def exchange(
        self, scene_id: str, time: float, updates: Sequence[TrackUpdate], history_s: float | None = None
    ) -> ExchangeResult:
        """Store the updates of a call and return what they complete: atomic, and one round trip.

        The first observation and forecast of an agent at a time (to ``TIME_TOLERANCE``) is kept, so that a
        call may be repeated.

        Args:
            scene_id: the scene.
            time: time of the call and of its forecasts, s.
            updates: one update per agent.
            history_s: seconds of history before ``time`` to return; None: no histories.

        Raises:
            StoreError: the store is unavailable; the updates may or may not have been stored.
        """

    @abstractmethod
    async def read(self, scene_id: str, window: float, agent_id: str | None = None) -> SceneSnapshot:
        """Return what is stored about one agent or all agents.

        Args:
            scene_id: the scene.
            window: seconds before an agent's newest observation to return.
            agent_id: the agent; None: all.

        Raises:
            StoreError: the store is unavailable.
        """

    @abstractmethod
    async def reset(self, scene_id: str) -> int:
        """Delete a scene and return the number of its agents.

        Raises:
            StoreError: the store is unavailable; the scene may have been deleted.
        """

    @abstractmethod
    async def publish(self, scene_id: str, events: Sequence[bytes]) -> None:
        """Send events to the watchers of a scene.

        Args:
            scene_id: the scene.
            events: events in order.

        Raises:
            StoreError: the store is unavailable; the events may or may not have been sent.
        """

    @abstractmethod
    def watch(self, scene_id: str) -> "AsyncGenerator[tuple[Sequence[bytes], int], None]":
        """Yield the events of a scene that any server of this store publishes from now on.

        The first item has no events and confirms that the watch has begun. Each further item has events,
        oldest first, and the number of events that this reader missed before them.

        Raises:
            StoreError: the store is unavailable.
        """

    async def ping(self) -> None:  # noqa: B027 - a store in the process always answers
        """Ask for a sign of life.

        Raises:
            StoreError: the store is unavailable.
        """

    @abstractmethod
    async def close(self) -> None:
        """Release all resources."""
