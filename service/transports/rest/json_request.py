"""Requests as JSON: counted first, then read.

``ParseDict`` takes ten microseconds over a number, and a request has up to a million of them, nearly all
in states. So states of nothing but numbers, which is how they are sent, are made by protobuf itself, in one
call each, and the rest of the request goes through ``ParseDict``.
"""

from typing import Any

from cab.forecast.v1 import prediction_service_pb2 as pb
from service.errors import TooLarge
from service.predict.request_reader import RequestLimits
from service.transports.rest.codec import from_document, load_document

_AGENTS = pb.PredictRequest.DESCRIPTOR.fields_by_number[pb.PredictRequest.AGENTS_FIELD_NUMBER].name
_STATES = pb.Agent.DESCRIPTOR.fields_by_number[pb.Agent.STATES_FIELD_NUMBER].name
_STATE_FIELDS = {
    spelling: field.name
    for field in pb.AgentState.DESCRIPTOR.fields
    for spelling in (field.name, field.json_name)
}
_BRACKETS_OF_AN_AGENT = 256
"""Objects and lists besides states, and brackets in its id."""
_VALUES_OF_AN_AGENT = 512
"""Values besides those of states, and commas in its id."""
_VALUES_OF_A_STATE = len(pb.AgentState.DESCRIPTOR.fields)


def read_request(body: bytes, limits: RequestLimits) -> pb.PredictRequest:
    """A request from JSON.

    Raises:
        TooLarge: it holds more agents or states than it may.
        BadField: it is no request; names the field as far as it can be told.
    """
    _check_body(body, limits)
    document = load_document(body)
    _check_document(document, limits)
    states = _take_plain_states(document)
    request = from_document(pb.PredictRequest, document)
    for index, plain in states.items():
        request.agents[index].states.extend(plain)
    return request


def _check_body(body: bytes, limits: RequestLimits) -> None:
    """Bounds what the JSON parser makes, which is twenty times the size of the text at worst."""
    if body.count(b"{") + body.count(b"[") > limits.states + _BRACKETS_OF_AN_AGENT * (limits.agents + 1):
        raise TooLarge(f"more objects than {limits.agents} agents and {limits.states} states have")
    if body.count(b",") > limits.states * _VALUES_OF_A_STATE + _VALUES_OF_AN_AGENT * (limits.agents + 1):
        raise TooLarge(f"more values than {limits.agents} agents and {limits.states} states have")


def _check_document(document: dict[str, Any], limits: RequestLimits) -> None:
    agents = document.get(_AGENTS)
    if not isinstance(agents, list):
        return
    limits.check_agents(len(agents))
    states = [agent[_STATES] for agent in agents if isinstance(agent, dict) and _STATES in agent]
    limits.check_states(sum(len(each) for each in states if isinstance(each, list)))


def _take_plain_states(document: dict[str, Any]) -> dict[int, list[pb.AgentState]]:
    """Takes the states out of the document of each agent all states of which are plain, by index."""
    taken: dict[int, list[pb.AgentState]] = {}
    agents = document.get(_AGENTS)
    for index, agent in enumerate(agents if isinstance(agents, list) else ()):
        states = agent.get(_STATES) if isinstance(agent, dict) else None
        if not isinstance(states, list):
            continue
        plain = _plain_states(states)
        if plain is not None:
            del agent[_STATES]
            taken[index] = plain
    return taken


def _plain_states(states: list[Any]) -> list[pb.AgentState] | None:
    """The states; None where any of them is for ``ParseDict`` to read, or to refuse."""
    made = []
    for state in states:
        if not isinstance(state, dict):
            return None
        values: dict[str, float] = {}
        for spelling, value in state.items():
            name = _STATE_FIELDS.get(spelling)
            if name is None or name in values or type(value) not in (float, int):  # a bool is an int, too
                return None
            values[name] = value
        made.append(pb.AgentState(**values))
    return made
