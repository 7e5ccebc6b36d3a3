"""The demo that moves: ticks of scenes, and their calls in real time."""

import time
from itertools import pairwise

import numpy as np
import pytest

from cab_forecast import Client, scene_raster
from cab_forecast.demo.live import play
from cab_forecast.demo.scenes import SCENES
from cab_forecast.demo.simulation import Simulation
from cab_forecast.demo.ticks import RecordedTicks, RecordedTrack, Recording, SimulatedTicks
from cab_forecast.errors import DeadlineExceeded
from cab_forecast.forecast import type_name
from tests.cab_forecast.fakes import Failure, Script, grpc_fake


def simulated(rate: float = 10.0) -> SimulatedTicks:
    """Return ticks of a few road users."""
    return SimulatedTicks(Simulation(SCENES["roundabout"](), users=6), rate)


def recorded() -> RecordedTicks:
    """Return ticks of two scenes of a vehicle and, in the first, a second one."""
    tracks = [
        RecordedTrack("7", "vehicle", np.arange(3, 9), np.arange(12.0).reshape(6, 2), np.zeros(6)),
        RecordedTrack("8", "vehicle", np.array([5, 6]), np.ones((2, 2)), np.zeros(2)),
    ]
    raster = scene_raster(np.ones((3, 4, 4)), (0, 0))
    return RecordedTicks([Recording("one", tuple(tracks), raster), Recording("two", (tracks[1],), raster)])


@pytest.mark.parametrize("rate", [2.0, 10.0, 25.0])
def test_simulated_ticks_have_histories_of_two_seconds(rate: float) -> None:
    ticks = simulated(rate)
    for number in range(round(3 * rate)):
        request = ticks.tick(100.0 + number / rate)
    assert request.scene_id == "demo/roundabout"
    assert request.options.merge
    assert request.HasField("scene_raster")
    assert {type_name(agent.type) for agent in request.agents} == {"vehicle", "pedestrian", "cyclist"}
    longest = max(request.agents, key=lambda agent: len(agent.states))
    assert len(longest.states) == 2 * rate + 1
    for agent in request.agents:
        assert agent.states[-1].time == request.time
        assert all(b.time - a.time == pytest.approx(1 / rate) for a, b in pairwise(agent.states))


def test_recorded_ticks_are_those_of_the_annotations() -> None:
    ticks = recorded()
    requests = [ticks.tick(100.0 + number / 2) for number in range(9)]
    assert [request.scene_id for request in requests] == [
        *["demo/one"] * 6,
        *["demo/two"] * 2,
        "demo/one",  # it begins again
    ]
    assert [[agent.id for agent in request.agents] for request in requests[:4]] == [
        ["7"],
        ["7"],
        ["7", "8"],
        ["7", "8"],
    ]
    last = requests[5].agents[0].states
    assert [state.time for state in last] == [100.5, 101.0, 101.5, 102.0, 102.5]
    assert [(state.x, state.y) for state in last] == [(2, 3), (4, 5), (6, 7), (8, 9), (10, 11)]


def test_calls_come_in_real_time_with_the_map_by_its_digest(script: Script) -> None:
    ticks = simulated()
    with grpc_fake(script) as address, Client(address) as client:
        start = time.time()
        progress = list(play(client, ticks, seconds=1.0))
    assert [(done.calls + done.skipped, done.error) for done in progress] == [(10, None)]
    times = np.array([request.time for request in script.predicted])
    assert np.abs(times - start).min() < 0.5
    assert np.round(np.diff(times) / 0.1, 3) == pytest.approx(np.round(np.diff(times) / 0.1))
    assert {request.scene_id for request in script.predicted} == {"demo/roundabout"}
    whole = [request.scene_raster.image.ByteSize() > 0 for request in script.predicted]
    assert whole[0]
    assert not any(whole[2:])


def test_a_call_that_fails_does_not_end_the_demo(script: Script) -> None:
    script.failures = [Failure("UNAVAILABLE", 503, "UNAVAILABLE")]
    with grpc_fake(script) as address, Client(address, retries=0) as client:
        progress = list(play(client, simulated(), seconds=1.0))
    assert progress[0].error is None  # of the last call
    assert 1 <= progress[0].calls <= 9


def test_slow_calls_cost_ticks_but_the_scene_keeps_up(
    script: Script, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slowly(client: Client, request: object) -> None:
        time.sleep(0.25)
        raise DeadlineExceeded("late")

    monkeypatch.setattr(Client, "predict", slowly)
    ticks = simulated()
    start = time.monotonic()
    with Client("grpc://127.0.0.1:1") as client:
        (done,) = play(client, ticks, seconds=1.0)
    assert time.monotonic() - start < 2.0
    assert done.skipped >= 4
    assert isinstance(done.error, DeadlineExceeded)
