"""Which models of an endpoint are judged."""

from collections.abc import Iterable, Sequence

from packaging.version import InvalidVersion, Version

from benchmark import BenchmarkError
from cab.forecast.v1.model_service_pb2 import AGENT_TYPE_VEHICLE, INPUT_PROTOCOL_PAPER, Model
from model.forecaster import Protocol
from model.metrics.oracle import PHYSICS

HORIZON_S = 6.0
"""That is judged."""
KALMAN = "kalman"
BASELINES = frozenset({*PHYSICS, KALMAN})
"""Models that take their inputs by either protocol."""


def key(model: Model) -> str:
    """``name@version``."""
    return f"{model.name}@{model.version}"


def protocol_of(model: Model) -> Protocol:
    """Of the states that a model was trained on."""
    return Protocol.PAPER if model.protocol == INPUT_PROTOCOL_PAPER else Protocol.CAUSAL


def learned(model: Model) -> bool:
    """Whether there are weights in it, so that the protocol of its inputs matters."""
    return model.name not in BASELINES


def oldest_first(keys: Iterable[str]) -> list[str]:
    """``name@version`` in the order of names, then of versions."""

    def order(one: str) -> tuple[str, Version, str]:
        name, _, version = one.partition("@")
        try:
            return name, Version(version), version
        except InvalidVersion:  # an endpoint may number its models as it likes
            return name, Version("0"), version

    return sorted(keys, key=order)


def unfit(model: Model, protocol: Protocol) -> str:
    """Why a model is not judged unless it is named; empty: it is."""
    if learned(model) and protocol_of(model) is not protocol:
        return f"trained by the {protocol_of(model).value} protocol"
    if AGENT_TYPE_VEHICLE not in model.agent_types:
        return "forecasts no vehicles"
    return ""


def choose(
    listed: Sequence[Model], protocol: Protocol, names: Sequence[str] = (), place: str = "the endpoint"
) -> dict[str, Model]:
    """Chooses among models.

    Args:
        listed: all that there are.
        protocol: of the inputs. Learned models of the other one are left out unless they are named: what is
            unlike their training is no measure of them.
        names: ``name`` (its newest version of that protocol) or ``name@version``; empty: all.
        place: where they are, for errors.

    Returns:
        By ``key``, in the order of the list or of the names.

    Raises:
        BenchmarkError: there is no such model, none that fits, or one that does not forecast far enough.
    """
    by_key = {key(one): one for one in listed}
    listed = [by_key[one] for one in oldest_first(by_key)]
    fitting = [one for one in listed if not unfit(one, protocol)]
    chosen = [_named(name, listed, fitting, place) for name in names] if names else fitting
    if not chosen:
        raise BenchmarkError(f"{place} has no model of the {protocol.value} protocol that forecasts vehicles")
    short = [key(one) for one in chosen if one.horizon < HORIZON_S]
    if short:
        raise BenchmarkError(f"{', '.join(short)}: forecasts less than {HORIZON_S:g} s; name the others")
    return {key(one): one for one in chosen}


def _named(name: str, listed: Sequence[Model], fitting: Sequence[Model], place: str) -> Model:
    exact = [one for one in listed if key(one) == name]
    newest = [one for one in fitting if one.name == name] or [one for one in listed if one.name == name]
    if not exact and not newest:
        have = ", ".join(sorted(key(one) for one in listed)) or "none"
        raise BenchmarkError(f"{place} has no model {name!r}; it has {have}")
    return (exact or newest)[-1]
