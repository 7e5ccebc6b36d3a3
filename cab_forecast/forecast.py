"""Forecasts as numpy arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from cab.forecast.v1.consistency_service_pb2 import InstantConsistency, TrackingStatus
from cab.forecast.v1.model_service_pb2 import ModelReference
from cab.forecast.v1.prediction_service_pb2 import AgentForecast, ForecastStatus, PredictResponse

_Floats = npt.NDArray[np.float64]


class Status(StrEnum):
    """How an agent's forecast came out."""

    UNSPECIFIED = "UNSPECIFIED"
    """Something that this client does not know of yet."""
    OK = "OK"
    SHORT_HISTORY = "SHORT_HISTORY"
    FALLBACK = "FALLBACK"
    INVALID = "INVALID"


class Tracking(StrEnum):
    """What became of the server's memory of an agent or a scene in a call."""

    UNSPECIFIED = "UNSPECIFIED"
    """Not tracked, or something that this client does not know of yet."""
    OK = "OK"
    NEW = "NEW"
    RESET = "RESET"
    """What was remembered did not fit, or was gone."""
    UNAVAILABLE = "UNAVAILABLE"
    """The memory did not answer in time."""


@dataclass(frozen=True)
class Forecast:
    """A Gaussian mixture over one agent's future positions: K modes, T steps; ground frame.

    With status INVALID there is none: K is 0.
    """

    agent_id: str
    status: Status
    detail: str
    """Why the status is not OK."""
    field: str
    """With INVALID: the field that is wrong."""
    model: ModelReference
    """The model that made it; with FALLBACK another one than was asked for."""
    history_frames: int
    """History frames that it rests on, the present one included."""
    times: _Floats
    """[T], s since the epoch."""
    mode_ids: npt.NDArray[np.int64]
    """[K], the model's own numbers of the modes."""
    weights: _Floats
    """[K]; with ``remaining_weight`` they sum to 1."""
    remaining_weight: float
    """Probability of the modes that were not returned."""
    means: _Floats
    """[K, T, 2], m."""
    covariances: _Floats
    """[K, T, 2, 2], m²."""
    most_likely_mode: int
    """Index of the mode of greatest weight."""
    samples: _Floats
    """[S, T, 2], m."""
    tracking: Tracking
    """What became of the memory of this agent."""
    consistency: InstantConsistency | None
    """What the model said before about the agent's newest observation; None: it was not asked for, or there
    is nothing."""

    @property
    def most_likely(self) -> _Floats:
        """[T, 2], the means of the likeliest mode, m.

        Raises:
            ValueError: there is no forecast.
        """
        if not len(self.weights):
            raise ValueError(f"agent {self.agent_id!r} has no forecast: {self.status}, {self.detail}")
        likely: _Floats = self.means[self.most_likely_mode]
        return likely

    @property
    def ranked_modes(self) -> npt.NDArray[np.int64]:
        """[K], indices of the modes, the likeliest first."""
        return np.argsort(-self.weights, kind="stable")


def forecasts(response: PredictResponse) -> dict[str, Forecast]:
    """The forecasts of a call by agent id, in the request's order.

    Should the server report an id twice (the second time as INVALID, for being one too many), the first
    report stays.

    Raises:
        ValueError: sizes in the response contradict each other.
    """
    found: dict[str, Forecast] = {}
    for entry in response.forecasts:
        found.setdefault(entry.agent_id, _forecast(entry, response))
    return found


def tracking(answer: PredictResponse | AgentForecast) -> Tracking:
    """What became of the memory of a call's scene, or of an agent in it."""
    number = answer.tracking
    # A newer server may know more of them.
    name = TrackingStatus.Name(number) if number in TrackingStatus.values() else ""
    return Tracking.__members__.get(name.removeprefix("TRACKING_STATUS_"), Tracking.UNSPECIFIED)


def _forecast(entry: AgentForecast, response: PredictResponse) -> Forecast:
    steps, modes = response.steps, len(entry.weights)
    if modes and entry.most_likely_mode >= modes:
        raise ValueError(f"agent {entry.agent_id!r}: no mode {entry.most_likely_mode} among {modes}")
    if len(entry.mode_ids) not in (0, modes):
        raise ValueError(f"agent {entry.agent_id!r}: {len(entry.mode_ids)} mode ids for {modes} modes")
    covariances = _shaped(entry, "covariances", entry.covariances, (modes, steps, 3))
    samples = len(entry.samples) // (steps * 2) if steps else 0
    return Forecast(
        agent_id=entry.agent_id,
        status=_status(entry.status),
        detail=entry.detail,
        field=entry.field,
        model=entry.model,
        history_frames=entry.history_frames,
        times=response.time + response.step * np.arange(1, steps + 1, dtype=np.float64),
        mode_ids=np.array(entry.mode_ids or range(modes), dtype=np.int64),
        weights=np.array(entry.weights, dtype=np.float64),
        remaining_weight=entry.remaining_weight,
        means=_shaped(entry, "means", entry.means, (modes, steps, 2)),
        covariances=covariances[..., [0, 1, 1, 2]].reshape(modes, steps, 2, 2),
        most_likely_mode=entry.most_likely_mode,
        samples=_shaped(entry, "samples", entry.samples, (samples, steps, 2)),
        tracking=tracking(entry),
        consistency=entry.consistency if entry.HasField("consistency") else None,
    )


def _shaped(entry: AgentForecast, name: str, values: Sequence[float], shape: tuple[int, ...]) -> _Floats:
    array = np.array(values, dtype=np.float64)
    if array.size != np.prod(shape):
        raise ValueError(f"agent {entry.agent_id!r}: {array.size} numbers in {name} cannot be {list(shape)}")
    return array.reshape(shape)


def _status(number: int) -> Status:
    # A newer server may know more of them.
    name = ForecastStatus.Name(number) if number in ForecastStatus.values() else ""  # type: ignore[arg-type]
    return Status.__members__.get(name.removeprefix("FORECAST_STATUS_"), Status.UNSPECIFIED)
