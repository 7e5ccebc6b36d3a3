"""The contract's enums and references in words for people."""

from collections.abc import Iterable

from cab.forecast.v1.model_service_pb2 import AgentType, InputProtocol, ModelReference


def type_name(number: int) -> str:
    """An AgentType, e.g. ``vehicle``; ``unspecified`` for what this client does not know."""
    return _name(AgentType.items(), "AGENT_TYPE_", number)


def protocol_name(number: int) -> str:
    """An InputProtocol, e.g. ``causal``; ``unspecified`` for what this client does not know."""
    return _name(InputProtocol.items(), "INPUT_PROTOCOL_", number)


def model_name(model: ModelReference) -> str:
    """``name@version``, or the name alone where there is no version."""
    return f"{model.name}@{model.version}" if model.version else model.name


def _name(items: Iterable[tuple[str, int]], prefix: str, number: int) -> str:
    known = {value: name.removeprefix(prefix).lower() for name, value in items}
    return known.get(number, "unspecified")
