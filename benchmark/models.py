"""Selection of the models of an endpoint."""

from collections.abc import Iterable, Sequence

from packaging.version import InvalidVersion, Version

from benchmark.errors import BenchmarkError
from cab.forecast.v1.model_service_pb2 import (
    AGENT_TYPE_VEHICLE,
    INPUT_PROTOCOL_PAPER,
    AgentType,
    InputProtocol,
    Model,
)
from model.forecaster import ModelInfo, Protocol
from model.metrics.oracle import PHYSICS
from model.scenes.scene import STEP_SECONDS

HORIZON_S = 6.0
"""Horizon that is evaluated."""
KALMAN = "kalman"
BASELINES = frozenset({*PHYSICS, KALMAN})
"""Models without training data, whose inputs may follow either protocol."""


def key(model: Model) -> str:
    """Return ``name@version``."""
    return f"{model.name}@{model.version}"


def describe(info: ModelInfo) -> Model:
    """Return the description of a model in this process, as an endpoint lists it."""
    return Model(
        name=info.name,
        version=info.version,
        protocol=InputProtocol.Value(f"INPUT_PROTOCOL_{info.protocol.name}"),
        description=info.description,
        agent_types=[AgentType.Value(f"AGENT_TYPE_{kind.name}") for kind in info.agent_types],
        horizon=info.horizon,
        step=STEP_SECONDS,
        history_frames=info.history_frames,
        modes=info.modes,
        trained_on=info.trained_on,
        benchmark=info.benchmark,
        license=info.license,
    )


def protocol_of(model: Model) -> Protocol:
    """Return the protocol of a model's training data."""
    return Protocol.PAPER if model.protocol == INPUT_PROTOCOL_PAPER else Protocol.CAUSAL


def is_learned(model: Model) -> bool:
    """Return whether a model was trained, so that the protocol of its inputs matters."""
    return model.name not in BASELINES


def oldest_first(keys: Iterable[str]) -> list[str]:
    """Sort ``name@version`` by name, then by version."""

    def order(one: str) -> tuple[str, Version, str]:
        name, _, version = one.partition("@")
        try:
            return name, Version(version), version
        except InvalidVersion:  # an endpoint may use other version numbers
            return name, Version("0"), version

    return sorted(keys, key=order)


def unfit(model: Model, protocol: Protocol) -> str:
    """Return why a model is left out unless it is named; empty: it is not left out."""
    if is_learned(model) and protocol_of(model) is not protocol:
        return f"trained by the {protocol_of(model).value} protocol"
    if AGENT_TYPE_VEHICLE not in model.agent_types:
        return "forecasts no vehicles"
    return ""


def select(
    listed: Sequence[Model], protocol: Protocol, names: Sequence[str] = (), place: str = "the endpoint"
) -> dict[str, Model]:
    """Select models.

    Args:
        listed: all models.
        protocol: protocol of the inputs. Models trained by the other one are left out unless they are named:
            inputs unlike their training data are no fair test.
        names: ``name`` (its newest version of that protocol) or ``name@version``; empty: all.
        place: where the models are, for errors.

    Returns:
        Models by ``key``, sorted, or in the order of the names.

    Raises:
        BenchmarkError: a name is unknown, no model fits, or a model forecasts less than ``HORIZON_S``.
    """
    by_key = {key(one): one for one in listed}
    listed = [by_key[one] for one in oldest_first(by_key)]
    fitting = [one for one in listed if not unfit(one, protocol)]
    selected = [_named(name, listed, fitting, place) for name in names] if names else fitting
    if not selected:
        raise BenchmarkError(f"{place} has no model of the {protocol.value} protocol that forecasts vehicles")
    short = [key(one) for one in selected if one.horizon < HORIZON_S]
    if short:
        raise BenchmarkError(f"{', '.join(short)}: forecasts less than {HORIZON_S:g} s; name the others")
    return {key(one): one for one in selected}


def _named(name: str, listed: Sequence[Model], fitting: Sequence[Model], place: str) -> Model:
    exact = [one for one in listed if key(one) == name]
    newest = [one for one in fitting if one.name == name] or [one for one in listed if one.name == name]
    if not exact and not newest:
        have = ", ".join(sorted(key(one) for one in listed)) or "none"
        raise BenchmarkError(f"{place} has no model {name!r}; it has {have}")
    return (exact or newest)[-1]
