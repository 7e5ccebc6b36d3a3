"""Memory of one agent."""

import math
import struct
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from model.scenes.scene import STEP_SECONDS
from service.tracking.store.base import MAX_MODELS, SETTLE_AFTER, Instants, TrackUpdate
from service.tracking.store.forecast_history import MAX_OFFSET, ForecastHistory, ForecastSet
from service.tracking.store.observation_buffer import ObservationBuffer
from service.tracking.store.records import AGES, COMPLETE, NEWLY, SETTLED

_HEAD = struct.Struct(f"<Qddd{AGES}d")


class Instant(NamedTuple):
    """One observation with the forecasts of one model for it."""

    packed: bytes
    """One record of ``records.INSTANT``."""
    agent_id: str
    model: str


def join_instants(instants: Sequence[Instant]) -> Instants:
    """Return instants as columns."""
    return Instants(
        b"".join([instant.packed for instant in instants]),
        [instant.agent_id for instant in instants],
        [instant.model for instant in instants],
    )


class Track:
    """Observations and forecasts of one agent.

    Args:
        agent_type: one of ``records.AGENT_TYPES``.
    """

    def __init__(self, agent_type: bytes) -> None:
        self.agent_type = agent_type
        """Type in the newest call, one of ``records.AGENT_TYPES``."""
        self._observations = ObservationBuffer()
        self._forecasts: dict[str, ForecastHistory] = {}
        """Forecasts by model."""

    @property
    def newest(self) -> float:
        """Time of the newest observation or forecast, s."""
        newest = self._observations.times[-1] if len(self._observations) else -math.inf
        for forecasts in self._forecasts.values():
            if len(forecasts):
                newest = max(newest, forecasts.times[-1])
        return newest

    def fits(self, observations: ObservationBuffer) -> bool:
        """Return whether the observations of a call can be of this agent.

        Detectors waver between types, so the type does not count.

        Args:
            observations: observations of the call.
        """
        return self._observations.agrees(observations)

    def apply(
        self, update: TrackUpdate, observations: ObservationBuffer, time: float, cut: float
    ) -> list[Instant]:
        """Store an update that fits.

        Args:
            update: the update.
            observations: its observations, parsed.
            time: time of the call, s.
            cut: time before which everything is dropped, s.

        Returns:
            The newest observation of the call, if the update names a model, and all instants that it settled.
        """
        observations.trim(cut)
        self._observations.insert(observations)
        own = self._forecasts.get(update.model)
        if own is None and update.forecast and len(self._forecasts) < MAX_MODELS:
            own = self._forecasts[update.model] = ForecastHistory()
        inserted = (
            own is not None and bool(update.forecast) and own.insert(time, update.forecast, update.steps)
        )
        reported: list[Instant] = []
        for observed in observations.times:
            at = self._observations.last_until(observed)
            newest = observed == observations.times[-1]
            for model, forecasts in self._forecasts.items():
                requested = newest and model == update.model
                self._settle(reported, update.agent_id, model, forecasts, at, requested)
            if newest and update.model and own is None:
                self._settle(reported, update.agent_id, update.model, ForecastHistory(), at, True)
        for model, forecasts in self._forecasts.items():
            for instant in tuple(forecasts.pending):
                if self._observations.times[-1] - instant >= SETTLE_AFTER:
                    at = self._observations.last_until(instant)
                    self._settle(reported, update.agent_id, model, forecasts, at, False)
        if inserted and own is not None:
            for at in self._observations_ahead(time):
                self._settle(reported, update.agent_id, update.model, own, at, False)
        # Trim last: a set that is due must settle with all forecasts that were there for it
        self._observations.trim(cut)
        for forecasts in self._forecasts.values():
            forecasts.trim(cut)
        return reported

    def history(self, time: float, history_s: float) -> bytes:
        """Return the observations of the last ``history_s`` seconds before a time, at least the last one.

        They are packed: see ``records.unpack_observations``.
        """
        return self._observations.history(time, history_s)

    def snapshot(self, agent_id: str, window: float) -> Iterator[Instant]:
        """Yield the current set of each observation of the last ``window`` seconds, for every model."""
        times = self._observations.times
        for at in range(bisect_left(times, times[-1] - window) if times else 0, len(times)):
            instant = times[at]
            for model, forecasts in self._forecasts.items():
                found = forecasts.collect(instant)
                flags = COMPLETE * found.complete + SETTLED * forecasts.is_settled(instant)
                yield self._instant(agent_id, model, at, found, flags)

    def _observations_ahead(self, made: float) -> Iterator[int]:
        """Yield the indices of the observations at a lag of a forecast, newest first."""
        times = self._observations.times
        for at in range(len(times) - 1, -1, -1):
            ahead = times[at] - made
            if ahead < STEP_SECONDS - MAX_OFFSET:
                return
            if abs(ahead - STEP_SECONDS * math.floor(ahead / STEP_SECONDS + 0.5)) <= MAX_OFFSET:
                yield at

    def _settle(
        self,
        reported: list[Instant],
        agent_id: str,
        model: str,
        forecasts: ForecastHistory,
        at: int,
        requested: bool,
    ) -> None:
        """Settle the set of one observation if possible; report it if it settles or is requested."""
        instant = self._observations.times[at]
        settled = forecasts.is_settled(instant)
        if not requested and (settled or not forecasts.may_be_complete(instant)):
            return
        found = forecasts.collect(instant)
        newly = False
        if found.complete and not settled:
            newly = found.exact or self._observations.times[-1] - instant >= SETTLE_AFTER
            (forecasts.mark_settled if newly else forecasts.mark_pending)(instant)
        if requested or newly:
            flags = COMPLETE * found.complete + SETTLED * (settled or newly) + NEWLY * newly
            reported.append(self._instant(agent_id, model, at, found, flags))

    def _instant(self, agent_id: str, model: str, at: int, found: ForecastSet, flags: int) -> Instant:
        head = _HEAD.pack(
            flags, self._observations.times[at], *self._observations.position(at), *found.made_at
        )
        return Instant(b"".join((head, *found.blocks)), agent_id, model)
