"""Scenes that a server remembers, many at a time."""

from concurrent.futures import ThreadPoolExecutor

from cab_forecast import predict_request
from loadtest.stores import Store
from loadtest.traffic import START, Traffic

MODEL = "kalman"
SECONDS = 11.5
"""Of each scene's time: a little more than is remembered."""
_SCENE_AGENTS = 40
_CALLS = 4
"""At a time."""


class Crowd:
    """Scenes of a server, each with a few agents, that are remembered whole.

    Args:
        store: the server.
        name: begins the ids of its scenes.
        tracked: False: the same calls, but nothing is remembered.
    """

    def __init__(self, store: Store, name: str, tracked: bool = True) -> None:
        self.agents = 0
        """Of all scenes."""
        self.name = name
        self._store = store
        self._tracked = tracked
        self._scenes = 0

    def grow(self, agents: int, rate: float) -> None:
        """Adds agents, in scenes of their own.

        Args:
            agents: how many there are in the end.
            rate: calls of each scene, Hz.
        """
        sizes = [min(_SCENE_AGENTS, agents - begun) for begun in range(self.agents, agents, _SCENE_AGENTS)]
        numbers = range(self._scenes, self._scenes + len(sizes))
        traffic = [Traffic(size, number) for size, number in zip(sizes, numbers, strict=True)]
        with ThreadPoolExecutor(_CALLS) as pool:
            for frame in range(round(SECONDS * rate)):
                times = [START + frame / rate] * len(sizes)
                list(
                    pool.map(self._call, times, numbers, traffic)
                )  # to its end: a scene's calls stay in order
        self.agents, self._scenes = max(agents, self.agents), numbers.stop

    def _id(self, number: int) -> str:
        return f"{self.name}-{number}"

    def _call(self, now: float, number: int, traffic: Traffic) -> None:
        request = predict_request(
            now,
            traffic.agents(now, 1),
            scene_id=self._id(number) if self._tracked else "",
            model=MODEL,
            max_modes=1,
            merge=False,
        )
        self._store.client.predict(request)
