"""Which models of an endpoint are judged."""

from collections.abc import Sequence

from benchmark import BenchmarkError
from cab.forecast.v1.model_service_pb2 import INPUT_PROTOCOL_PAPER, Model
from model.forecaster import Protocol
from model.metrics.oracle import PHYSICS

PHYSICS_ORACLE = "physics-oracle"
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


def choose(listed: Sequence[Model], protocol: Protocol, names: Sequence[str] = ()) -> dict[str, Model]:
    """Chooses among the models that an endpoint lists.

    Args:
        listed: all of them.
        protocol: of the inputs. Learned models of the other one are left out unless they are named: what is
            unlike their training is no measure of them.
        names: ``name`` (its newest version of that protocol) or ``name@version``; empty: all.

    Returns:
        By ``key``, in the order of the list or of the names.

    Raises:
        BenchmarkError: the endpoint has no such model, or none that fits.
    """
    fitting = [one for one in listed if not learned(one) or protocol_of(one) is protocol]
    chosen = [_named(name, listed, fitting) for name in names] if names else fitting
    if not chosen:
        raise BenchmarkError(f"the endpoint lists no model of the {protocol.value} protocol")
    return {key(one): one for one in chosen}


def _named(name: str, listed: Sequence[Model], fitting: Sequence[Model]) -> Model:
    exact = [one for one in listed if key(one) == name]
    # Listed oldest first
    newest = [one for one in fitting if one.name == name] or [one for one in listed if one.name == name]
    if not exact and not newest:
        have = ", ".join(sorted(key(one) for one in listed)) or "none"
        raise BenchmarkError(f"the endpoint has no model {name!r}; it has {have}")
    return (exact or newest)[-1]
