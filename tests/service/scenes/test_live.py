"""The scenes that were called lately."""

import pytest

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import scene_service_pb2 as pb
from service.scenes.live import MAX_SCENES, LiveScenes, merged

MODEL = models_pb.ModelReference(name="kalman", version="1.0.0")


class Clock:
    """Clock that a test sets."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_the_scene_that_was_called_last_comes_first() -> None:
    clock = Clock()
    live = LiveScenes(30.0, clock)
    for name, time in (("a", 1.0), ("b", 2.0), ("a", 1.5)):
        clock.now += 1.0
        live.called(name, time, 3, MODEL)
    first, second = live.summaries()
    assert (first.scene_id, first.time, first.agents, first.updated_time) == ("a", 1.5, 3, 1003.0)
    assert first.model == MODEL
    assert second.scene_id == "b"


def test_scenes_expire_and_their_number_is_bounded() -> None:
    clock = Clock()
    live = LiveScenes(30.0, clock)
    for index in range(MAX_SCENES + 5):
        live.called(f"{index}", 0.0, 1, MODEL)
    assert len(live) == MAX_SCENES
    clock.now += 20.0
    live.called("late", 0.0, 1, MODEL)
    assert live.summaries()[-1].scene_id == "6"
    clock.now += 15.0
    assert [one.scene_id for one in live.summaries()] == ["late"]


@pytest.mark.parametrize("hertz", [1.0, 10.0, 40.0])
def test_rates(hertz: float) -> None:
    clock = Clock()
    live = LiveScenes(30.0, clock)
    for _ in range(int(8 * hertz)):
        live.called("s", 0.0, 1, MODEL)
        assert live.summaries()[0].rate_hz <= 1.01 * hertz
        clock.now += 1 / hertz
    assert live.summaries()[0].rate_hz == pytest.approx(hertz)
    clock.now += 3.0
    assert live.summaries()[0].rate_hz < 0.7 * hertz
    clock.now += 3.0
    assert live.summaries()[0].rate_hz == 0.0


def test_scenes_of_several_servers_become_one() -> None:
    several = [
        pb.SceneSummary(scene_id="s", time=1.0, updated_time=100.0, rate_hz=4.0),
        pb.SceneSummary(scene_id="s", time=1.2, updated_time=100.5, rate_hz=6.0),
        pb.SceneSummary(scene_id="s", time=0.2, updated_time=80.0, rate_hz=9.0),
        pb.SceneSummary(scene_id="t", time=7.0, updated_time=101.0, rate_hz=1.0),
    ]
    first, second = merged(several)
    assert (first.scene_id, second.scene_id) == ("t", "s")
    assert (second.time, second.updated_time, second.rate_hz) == (1.2, 100.5, 10.0)
    assert several[1].rate_hz == 6.0
