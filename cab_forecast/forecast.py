"""Forecasts as numpy arrays, and the contract's enums as Python values and words."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import numpy.typing as npt

from cab.forecast.v1.consistency_service_pb2 import InstantConsistency, TrackingStatus
from cab.forecast.v1.model_service_pb2 import AgentType, InputProtocol, ModelReference
from cab.forecast.v1.prediction_service_pb2 import (
    AgentForecast,
    ForecastStatus,
    InputWarningCode,
    PredictResponse,
)

_Floats = npt.NDArray[np.float64]


class Status(StrEnum):
    """Status of an agent's forecast."""

    UNSPECIFIED = "UNSPECIFIED"
    """A status that this client does not know."""
    OK = "OK"
    SHORT_HISTORY = "SHORT_HISTORY"
    FALLBACK = "FALLBACK"
    INVALID = "INVALID"


class Tracking(StrEnum):
    """Status of the track memory of an agent or a scene in a call."""

    UNSPECIFIED = "UNSPECIFIED"
    """Not tracked, or a status that this client does not know."""
    OK = "OK"
    NEW = "NEW"
    RESET = "RESET"
    """The track was inconsistent with the request, or lost, and starts anew."""
    UNAVAILABLE = "UNAVAILABLE"
    """The track memory did not respond in time."""


@dataclass(frozen=True)
class InputWarning:
    """A contradiction in an agent's input."""

    code: str
    """Kind of contradiction, e.g. ``VELOCITY_MISMATCH``; ``UNSPECIFIED``: this client does not know it."""
    detail: str
    """The parts of the input that contradict each other."""
    field: str
    """Path of the field in the request."""


@dataclass(frozen=True)
class Forecast:
    """A Gaussian mixture over one agent's future positions: K modes, T steps; ground frame.

    With status INVALID there is no forecast: K is 0.
    """

    agent_id: str
    status: Status
    detail: str
    """Reason for a status other than OK."""
    field: str
    """Invalid field, with INVALID."""
    model: ModelReference
    """The model that made the forecast; with FALLBACK not the requested one."""
    history_frames: int
    """Number of history frames used, the present one included."""
    times: _Floats
    """[T], seconds since the epoch."""
    mode_ids: npt.NDArray[np.int64]
    """[K], the model's own numbers of the modes."""
    weights: _Floats
    """[K], probabilities; they sum to 1 together with ``remaining_weight``."""
    remaining_weight: float
    """Probability of the modes that were not returned."""
    means: _Floats
    """[K, T, 2], m."""
    covariances: _Floats
    """[K, T, 2, 2], m²."""
    most_likely_mode: int
    """Index of the mode with the greatest weight."""
    samples: _Floats
    """[S, T, 2], m."""
    tracking: Tracking
    """Status of this agent's track."""
    consistency: InstantConsistency | None
    """Consistency of the forecasts of the agent's newest observation; None: not requested or not known."""
    warnings: tuple[InputWarning, ...]
    """Contradictions in the agent's input, whatever the status."""

    @property
    def most_likely(self) -> _Floats:
        """Means of the most likely mode: [T, 2], m.

        Raises:
            ValueError: there is no forecast.
        """
        if not len(self.weights):
            raise ValueError(f"agent {self.agent_id!r} has no forecast: {self.status}, {self.detail}")
        likely: _Floats = self.means[self.most_likely_mode]
        return likely

    @property
    def ranked_modes(self) -> npt.NDArray[np.int64]:
        """Indices of the modes, the most likely first: [K]."""
        return np.argsort(-self.weights, kind="stable")


def forecasts(response: PredictResponse) -> dict[str, Forecast]:
    """Return the forecasts of a response by agent id, in the request's order.

    If the request holds an id twice, the server reports both agents as INVALID; the first one is returned.

    Raises:
        ValueError: sizes in the response contradict each other.
    """
    found: dict[str, Forecast] = {}
    for entry in response.forecasts:
        found.setdefault(entry.agent_id, _forecast(entry, response))
    return found


def tracking(message: PredictResponse | AgentForecast) -> Tracking:
    """Return the status of the track memory, of a response's scene or of one agent."""
    number = message.tracking
    # A newer server may have more of them.
    name = TrackingStatus.Name(number) if number in TrackingStatus.values() else ""
    return Tracking.__members__.get(name.removeprefix("TRACKING_STATUS_"), Tracking.UNSPECIFIED)


def type_name(number: int) -> str:
    """Return an AgentType in words, e.g. ``vehicle``; ``unspecified`` if this client does not know it."""
    return _name(AgentType.items(), "AGENT_TYPE_", number)


def protocol_name(number: int) -> str:
    """Return an InputProtocol in words, e.g. ``causal``; ``unspecified`` if this client does not know it."""
    return _name(InputProtocol.items(), "INPUT_PROTOCOL_", number)


def model_name(model: ModelReference) -> str:
    """Return ``name@version``, or the name alone if there is no version."""
    return f"{model.name}@{model.version}" if model.version else model.name


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
        warnings=tuple(
            InputWarning(_warning_code(one.code), one.detail, one.field) for one in entry.warnings
        ),
    )


def _shaped(entry: AgentForecast, name: str, values: Sequence[float], shape: tuple[int, ...]) -> _Floats:
    array = np.array(values, dtype=np.float64)
    if array.size != np.prod(shape):
        raise ValueError(f"agent {entry.agent_id!r}: {array.size} numbers in {name} cannot be {list(shape)}")
    return array.reshape(shape)


def _status(number: int) -> Status:
    # A newer server may have more of them.
    name = ForecastStatus.Name(number) if number in ForecastStatus.values() else ""  # type: ignore[arg-type]
    return Status.__members__.get(name.removeprefix("FORECAST_STATUS_"), Status.UNSPECIFIED)


def _warning_code(number: int) -> str:
    return _name(InputWarningCode.items(), "INPUT_WARNING_CODE_", number).upper()


def _name(items: Iterable[tuple[str, int]], prefix: str, number: int) -> str:
    known = {value: name.removeprefix(prefix).lower() for name, value in items}
    return known.get(number, "unspecified")
