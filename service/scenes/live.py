"""The scenes that this process was called for lately."""

import time as clock
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import scene_service_pb2 as pb

MAX_SCENES = 1000
"""Max number of scenes; beyond it those that were called longest ago are forgotten."""
_RATE_WINDOW = 5.0
"""Seconds over which the rate of a scene is counted."""
_MAX_CALLS = 128
"""Max number of calls that it is counted from."""


@dataclass
class _Scene:
    """A scene and its newest call."""

    time: float
    agents: int
    model: models_pb.ModelReference
    calls: deque[float] = field(default_factory=lambda: deque(maxlen=_MAX_CALLS))
    """Times of its last calls on the clock, s."""


class LiveScenes:
    """Scenes by their last call. Used on one event loop."""

    def __init__(self, expiry: float, now: Callable[[], float] = clock.time) -> None:
        """
        Args:
            expiry: seconds without a call after which a scene is not live any more.
            now: clock, s since the epoch.
        """
        self._expiry = expiry
        self._now = now
        self._scenes: OrderedDict[str, _Scene] = OrderedDict()
        """Called longest ago first."""

    def __len__(self) -> int:
        return len(self._scenes)

    def called(self, scene_id: str, time: float, agents: int, model: models_pb.ModelReference) -> None:
        """Note an answered call. Takes microseconds.

        Args:
            scene_id: the scene.
            time: time of the call, s.
            agents: number of agents with a forecast.
            model: the requested model.
        """
        scene = self._scenes.get(scene_id)
        if scene is None:
            scene = self._scenes[scene_id] = _Scene(time, agents, model)
        else:
            scene.time, scene.agents, scene.model = time, agents, model
        scene.calls.append(self._now())
        self._scenes.move_to_end(scene_id)
        while len(self._scenes) > MAX_SCENES:
            self._scenes.popitem(last=False)

    def summaries(self) -> list[pb.SceneSummary]:
        """Return the live scenes, the one that was called last first."""
        now = self._now()
        while self._scenes and next(iter(self._scenes.values())).calls[-1] < now - self._expiry:
            self._scenes.popitem(last=False)
        return [
            pb.SceneSummary(
                scene_id=scene_id,
                time=scene.time,
                agents=scene.agents,
                model=scene.model,
                updated_time=scene.calls[-1],
                rate_hz=_rate(scene.calls, now),
            )
            for scene_id, scene in reversed(self._scenes.items())
        ]


def merged(summaries: Iterable[pb.SceneSummary]) -> list[pb.SceneSummary]:
    """Return one summary for each scene: that of its newest call, with the rates of all servers.

    Args:
        summaries: summaries of several servers, which do not change.

    Returns:
        At most ``MAX_SCENES``, the scene that was called last first.
    """
    by_scene: dict[str, list[pb.SceneSummary]] = {}
    for one in summaries:
        by_scene.setdefault(one.scene_id, []).append(one)
    scenes = []
    for several in by_scene.values():
        newest = pb.SceneSummary()
        newest.CopyFrom(max(several, key=lambda one: one.updated_time))
        recent = newest.updated_time - _RATE_WINDOW
        newest.rate_hz = sum(one.rate_hz for one in several if one.updated_time > recent)
        scenes.append(newest)
    return sorted(scenes, key=lambda one: -one.updated_time)[:MAX_SCENES]


def _rate(calls: deque[float], now: float) -> float:
    """Return the number of calls a second, by the last seconds; 0 for a single call."""
    recent = [called for called in calls if called > now - _RATE_WINDOW]
    if len(recent) < 2:
        return 0.0
    span, silence = recent[-1] - recent[0], now - recent[-1]
    intervals = len(recent) - 1
    if silence * intervals > 2 * span:  # the next call is overdue: the scene has slowed down, or ended
        span += silence
    return intervals / span if span > 0 else 0.0
