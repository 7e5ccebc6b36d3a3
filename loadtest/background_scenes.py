"""Scenes that fill a server's track memory while other calls are measured."""

from concurrent.futures import ThreadPoolExecutor

from cab_forecast import predict_request
from loadtest.stores import Store
from loadtest.traffic import START, Traffic

MODEL = "kalman"
SECONDS = 11.5
"""Duration of each scene: a little longer than the window of the track memory."""
_SCENE_AGENTS = 40
_CONCURRENT_CALLS = 4


class BackgroundScenes:
    """Scenes of one server, each with a few agents whose whole window is in the track memory.

    Args:
        store: the server.
        name: prefix of the scene ids.
        tracked: False: the same calls without track memory.
    """

    def __init__(self, store: Store, name: str, tracked: bool = True) -> None:
        self.agents = 0
        """Number of agents of all scenes."""
        self.name = name
        self._store = store
        self._tracked = tracked
        self._scenes = 0

    def grow(self, agents: int, rate: float) -> None:
        """Add agents in new scenes.

        Args:
            agents: total number of agents afterwards.
            rate: calls per scene, Hz.
        """
        sizes = [min(_SCENE_AGENTS, agents - first) for first in range(self.agents, agents, _SCENE_AGENTS)]
        numbers = range(self._scenes, self._scenes + len(sizes))
        traffic = [Traffic(size, number) for size, number in zip(sizes, numbers, strict=True)]
        with ThreadPoolExecutor(_CONCURRENT_CALLS) as pool:
            for frame in range(round(SECONDS * rate)):
                times = [START + frame / rate] * len(sizes)
                # Each frame ends before the next: the calls of a scene stay in order
                list(pool.map(self._call, times, numbers, traffic))
        self.agents, self._scenes = max(agents, self.agents), numbers.stop

    def _scene_id(self, number: int) -> str:
        return f"{self.name}-{number}"

    def _call(self, now: float, number: int, traffic: Traffic) -> None:
        request = predict_request(
            now,
            traffic.agents(now, 1),
            scene_id=self._scene_id(number) if self._tracked else "",
            model=MODEL,
            max_modes=1,
            merge=False,
        )
        self._store.client.predict(request)
