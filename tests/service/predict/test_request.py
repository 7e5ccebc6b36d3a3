"""Agents of a request: each fault is named, and costs its own agent only."""

import math
from collections.abc import Callable
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.scenes.scene import AgentType
from service.errors import Fault
from service.predict.request import read_agents
from service.settings import Settings
from tests.service.requests import NOW, PEDESTRIAN, add_agent, make_request, pack, png
from tests.service.timing import cpu_seconds

SETTINGS = Settings()
NAN, INF = math.nan, math.inf

Change = Callable[[pb.Agent], object]


def fault(change: Change) -> Fault:
    """The fault of the middle one of three agents after a change to it; the others have none."""
    request = make_request(3)
    change(request.agents[1])
    agents = read_agents(request, SETTINGS)
    assert list(agents.faults) == [1]
    assert agents.valid.tolist() == [0, 2]
    assert agents.observations is not None
    assert agents.observations.count.tolist() == [6, 6]
    return agents.faults[1]


def set_state(index: int, **values: float) -> Change:
    def change(agent: pb.Agent) -> None:
        for name, value in values.items():
            setattr(agent.states[index], name, value)

    return change


def clear_state(index: int, name: str) -> Change:
    return lambda agent: agent.states[index].ClearField(name)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "field", "detail"),
    [
        (lambda agent: agent.ClearField("id"), "id", "is required"),
        (lambda agent: setattr(agent, "id", "x" * 129), "id", "has 129 characters; at most 128"),
        (lambda agent: agent.ClearField("type"), "type", "type is required"),
        (lambda agent: setattr(agent, "type", 17), "type", "unknown value 17"),
        (lambda agent: agent.ClearField("states"), "states", "at least one is required"),
        (clear_state(0, "time"), "states[0].time", "is required"),
        (clear_state(2, "x"), "states[2].x", "is required"),
        (clear_state(5, "y"), "states[5].y", "is required"),
        (set_state(1, x=NAN), "states[1].x", "must be a finite number"),
        (set_state(1, y=-INF), "states[1].y", "must be a finite number"),
        (set_state(1, time=NAN), "states[1].time", "must be a finite number"),
        (set_state(1, heading=INF), "states[1].heading", "must be a finite number"),
        (set_state(1, heading_rate=NAN), "states[1].heading_rate", "must be a finite number"),
        (set_state(1, x=1.1e7), "states[1].x", "must be within ±1e+07"),
        (set_state(1, time=-2e10), "states[1].time", "must be within ±1e+10"),
        (set_state(1, heading=-10_001.0), "states[1].heading", "must be within ±10000"),
        (set_state(1, heading_rate=20.5), "states[1].heading_rate", "must be within ±20"),
        (set_state(1, velocity_x=151.0, velocity_y=0.0), "states[1].velocity_x", "must be within ±150"),
        (
            set_state(1, acceleration_x=0.0, acceleration_y=-101.0),
            "states[1].acceleration_y",
            "must be within ±100",
        ),
        (
            set_state(2, velocity_x=0.0),
            "states[2].velocity_y",
            "give both velocity_x and velocity_y or neither",
        ),
        (
            set_state(2, velocity_y=1.0),
            "states[2].velocity_x",
            "give both velocity_x and velocity_y or neither",
        ),
        (
            set_state(2, acceleration_x=1.0),
            "states[2].acceleration_y",
            "give both acceleration_x and acceleration_y or neither",
        ),
        (set_state(3, time=NOW - 1.5), "states[3].time", "must be after the state before it"),
        (set_state(3, time=NOW - 1.7), "states[3].time", "must be after the state before it"),
        (set_state(5, time=NOW + 0.2), "states[5].time", "is 0.2 s after the request's time"),
        (lambda agent: agent.states.pop(), "states[4].time", None),
        (set_state(4, x=100.0), "states[4].x", "jumps 105 m in 0.5 s from the state before it"),
    ],
)
def test_fault_is_named(change: Change, field: str, detail: str | None) -> None:
    if field == "states[4].time":  # the newest state 0.6 s old
        remove = change

        def change(agent: pb.Agent) -> None:
            remove(agent)
            agent.states[4].time = NOW - 0.6

        detail = "the newest state is 0.6 s old; at most 0.5 s"
    found = fault(change)
    assert found.field == f"agents[1].{field}"
    assert found.detail == detail


def test_first_fault_of_an_agent_is_told() -> None:
    def change(agent: pb.Agent) -> None:
        agent.states[3].y = NAN
        agent.states[1].heading = INF
        agent.states[5].time = 0.0

    assert fault(change).field == "agents[1].states[1].heading"


@pytest.mark.parametrize(
    "change",
    [
        set_state(1, x=NAN),
        set_state(1, x=9e7),
        set_state(1, velocity_x=0.0),
        set_state(3, time=NOW - 2.0),
        set_state(3, time=NOW + 1.0),
        set_state(4, x=1000.0),
    ],
)
def test_each_agent_is_told_its_own_first_fault(change: Change) -> None:
    request = make_request(4)
    for index in (1, 3):
        change(request.agents[index])
        request.agents[index].states[5].y = 500.0
        request.agents[index].states[5].acceleration_y = 0.0
    faults = read_agents(request, SETTINGS).faults
    assert sorted(faults) == [1, 3]
    assert faults[1].field.removeprefix("agents[1]") == faults[3].field.removeprefix("agents[3]")
    assert faults[1].detail == faults[3].detail


@pytest.mark.parametrize(
    ("values", "field"), [([NAN] * 9, "time"), ([NOW, 0.0, 0.0, 0.0, 0.0], "velocity_y")]
)
def test_of_a_hundred_thousand_faults_one_an_agent_is_put_into_words(
    values: list[float], field: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [each.name for each in pb.AgentState.DESCRIPTOR.fields]
    state = pb.AgentState(**dict(zip(names, values, strict=False)))
    request = pb.PredictRequest(time=NOW)
    for index in range(200):
        request.agents.add(id=f"a{index}", type=1, states=[state] * 500)
    put = Mock(side_effect=Fault)
    monkeypatch.setattr("service.predict.request.Fault", put)
    faults = read_agents(request, SETTINGS).faults
    assert faults[199].field == f"agents[199].states[0].{field}"
    assert put.call_count == 200
    assert cpu_seconds(lambda: read_agents(request, SETTINGS)) < 1.0  # some 0.06 s


def test_too_many_states() -> None:
    request = make_request(1)
    agents = read_agents(request, Settings(max_states=5))
    assert agents.faults[0] == Fault("agents[0].states", "has 6; at most 5")
    assert agents.observations is None


def test_shared_ids_are_all_invalid() -> None:
    request = make_request(4)
    request.agents[2].id = "a0"
    agents = read_agents(request, SETTINGS)
    assert sorted(agents.faults) == [0, 2]
    assert agents.faults[0] == Fault("agents[0].id", "2 agents share it")


def test_zero_is_a_value_and_missing_is_not_zero() -> None:
    request = pb.PredictRequest(time=0.0)
    agent = request.agents.add(id="a", type=1)
    agent.states.add(time=0.0, x=0.0, y=0.0, velocity_x=0.0, velocity_y=-0.0)
    agents = read_agents(request, SETTINGS)
    assert agents.faults == {}
    assert agents.observations is not None
    assert agents.observations.velocity.tolist() == [[[0.0, 0.0]]]
    assert np.isnan(agents.observations.heading).all()
    assert np.isnan(agents.observations.acceleration).all()


def test_observations_are_those_sent() -> None:
    request = pb.PredictRequest(time=NOW)
    add_agent(request, "a", frames=2, x=7.0)
    add_agent(request, "bad", frames=3).states[0].x = NAN
    add_agent(request, "b", kind=PEDESTRIAN, frames=3, y=3.0)
    request.agents[2].states[2].heading_rate = 0.5
    request.agents[2].predict = False
    agents = read_agents(request, SETTINGS)
    assert agents.ids == ["a", "bad", "b"]
    assert agents.predict.tolist() == [True, True, False]
    assert agents.types == [AgentType.VEHICLE, AgentType.PEDESTRIAN]
    observed = agents.observations
    assert observed is not None
    assert observed.count.tolist() == [2, 3]
    assert observed.time.tolist() == [[NOW - 0.5, NOW, INF], [NOW - 1.0, NOW - 0.5, NOW]]
    assert observed.position[0, :2].tolist() == [[4.5, 0.0], [7.0, 0.0]]
    assert np.isnan(observed.position[0, 2]).all()
    assert observed.position[1, 2].tolist() == [0.0, 3.0]
    assert observed.heading_rate[1].tolist()[2] == 0.5
    assert np.isnan(observed.heading_rate[1, :2]).all()


def test_the_present_has_a_tolerance() -> None:
    request = make_request(1)
    request.agents[0].states[5].time = NOW + 5e-5
    agents = read_agents(request, SETTINGS)
    assert agents.observations is not None
    assert agents.observations.time[0, -1] == NOW


def test_unknown_fields_of_a_newer_client_are_let_through() -> None:
    request = make_request(2)
    newer = b"\xfa\x07\x03abc"  # field 127, three bytes
    for size in (newer, newer[:0] + b"\xf1\x07" + bytes(8)):
        request.agents[0].states[0].MergeFromString(size)
    agents = read_agents(request, SETTINGS)
    assert agents.faults == {}
    assert agents.observations is not None
    assert np.array_equal(agents.observations.position[0, :, 0], agents.observations.position[1, :, 0])


def test_patches() -> None:
    layers = (np.random.default_rng(0).random((3, 100, 100)) > 0.5).astype(np.uint8)
    request = make_request(4)
    request.agents[0].states[0].x = NAN
    request.agents[1].map_patch.image.packed_bits = pack(layers)
    request.agents[3].map_patch.image.png = png(layers)
    request.agents[2].far_map_patch.image.png = png(layers)
    request.agents[3].far_map_patch.image.packed_bits = pack(layers)
    agents = read_agents(request, SETTINGS)
    assert sorted(agents.patches) == [0, 2]  # among the valid ones
    assert sorted(agents.far_patches) == [1, 2]
    for patches in (agents.patches, agents.far_patches):
        assert all(np.array_equal(patch, layers) for patch in patches.values())


@pytest.mark.parametrize("name", ["map_patch", "far_map_patch"])
@pytest.mark.parametrize(
    ("change", "field"),
    [
        (lambda patch: patch.SetInParent(), "image"),
        (lambda patch: setattr(patch.image, "packed_bits", b"123"), "image.packed_bits"),
        (lambda patch: setattr(patch.image, "png", b"123"), "image.png"),
        (
            lambda patch: setattr(patch.image, "png", png(np.zeros((3, 100, 99), dtype=np.uint8))),
            "image.png",
        ),
    ],
)
def test_a_bad_patch_costs_its_agent_only(
    change: Callable[[pb.MapPatch], None], field: str, name: str
) -> None:
    assert fault(lambda agent: change(getattr(agent, name))).field == f"agents[1].{name}.{field}"


def test_of_two_bad_patches_the_first_is_told() -> None:
    def spoil(agent: pb.Agent) -> None:
        agent.far_map_patch.image.packed_bits = b"123"
        agent.map_patch.image.packed_bits = b"123"

    assert fault(spoil).field == "agents[1].map_patch.image.packed_bits"


def test_speed() -> None:
    request = pb.PredictRequest(time=NOW)
    for index in range(128):
        add_agent(request, f"a{index}", frames=20)
    seconds = cpu_seconds(lambda: read_agents(request, SETTINGS), tries=5)
    assert seconds < 0.02  # some 2 ms; ten times that tells of a loop over numbers


numbers = st.floats(allow_nan=True, allow_infinity=True) | st.sampled_from([0.0, NOW, NOW - 0.5, NOW - 1.0])
states = st.builds(
    pb.AgentState,
    **{name: st.none() | numbers for name in (field.name for field in pb.AgentState.DESCRIPTOR.fields)},
)
requests = st.builds(
    pb.PredictRequest,
    time=st.sampled_from([0.0, NOW]) | st.floats(-1e10, 1e10),
    agents=st.lists(
        st.builds(
            pb.Agent,
            id=st.text(max_size=3),
            type=st.integers(-1, 6),
            states=st.lists(states, max_size=4),
            predict=st.none() | st.booleans(),
        ),
        max_size=4,
    ),
)


@given(requests)
def test_whatever_comes_is_either_valid_or_named(request: pb.PredictRequest) -> None:
    agents = read_agents(request, SETTINGS)
    assert sorted([*agents.faults, *agents.valid.tolist()]) == list(range(len(request.agents)))
    assert all(found.field.startswith(f"agents[{index}].") for index, found in agents.faults.items())
    if agents.observations is not None:
        rows = np.arange(agents.observations.time.shape[1]) < agents.observations.count[:, None]
        assert np.isfinite(agents.observations.position[rows]).all()
        assert (np.diff(agents.observations.time, axis=1)[rows[:, 1:]] > 0).all()
