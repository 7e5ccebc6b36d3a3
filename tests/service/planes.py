"""Consistency service that a test controls."""

import asyncio
import threading
import time
from collections.abc import AsyncGenerator

from google.protobuf.message import Message

from cab.forecast.v1 import consistency_service_pb2 as pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from service.server import Server
from service.tracking.service import ConsistencyService

MODEL = models_pb.ModelReference(name="fake", version="1.0.0", protocol=models_pb.INPUT_PROTOCOL_CAUSAL)
INSTANT = pb.InstantConsistency(
    agent_id="car\u2028 1",  # a line separator, to some
    time=1_700_000_000.25,
    model=MODEL,
    complete=True,
    settled=True,
    dispersion=pb.Dispersion(standard_deviation=0.31, mean=0.42, root_mean_square=0.52),
    convergence=[
        pb.Convergence(range=0.2, duration=0.5),
        pb.Convergence(range=1.0, duration=2.5),
        pb.Convergence(range=5.0, duration=6.0),
    ],
    errors=[pb.AgeError(age=0.5 * n, displacement_error=0.1 * n) for n in range(1, 13)],
)
SUMMARY = pb.Summary(count=3, mean=0.25, median=0.2, quantile_90=0.5, quantile_99=0.75)
SUMS = pb.ModelConsistency(
    model=MODEL,
    instants=3,
    dispersion_standard_deviation=SUMMARY,
    convergence=[pb.ConvergenceSummary(range=1.0, duration=SUMMARY)],
    errors=[pb.AgeSummary(age=3.0, displacement_error=SUMMARY, most_likely_was_nearest=0.5)],
)
EVENT = pb.WatchSceneResponse(instants=[INSTANT], missed=2)

AGENT = pb.GetAgentConsistencyResponse(instants=[INSTANT])
SCENE = pb.GetSceneConsistencyResponse(latest=[INSTANT], models=[SUMS])
MODELS = pb.ListModelConsistencyResponse(models=[SUMS])
RESET = pb.ResetSceneResponse(agents=7)


class FakePlane(ConsistencyService):
    """Consistency service with fixed responses; streams yield what is sent to them, from any thread."""

    def __init__(self) -> None:  # the real one's needs are none of the transports' business
        self.asked: list[Message] = []
        """All requests."""
        self.error: Exception | None = None
        """Error that ends every call; None: calls succeed."""
        self.silent = False
        """Flag for streams without a first, empty event."""
        self.watching = 0
        self._queues: list[asyncio.Queue[pb.WatchSceneResponse | Exception | None]] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self._lock = threading.Lock()

    async def get_agent(self, request: pb.GetAgentConsistencyRequest) -> pb.GetAgentConsistencyResponse:
        self._note(request)
        return AGENT

    async def get_scene(self, request: pb.GetSceneConsistencyRequest) -> pb.GetSceneConsistencyResponse:
        self._note(request)
        return SCENE

    async def list_models(self, request: pb.ListModelConsistencyRequest) -> pb.ListModelConsistencyResponse:
        self._note(request)
        return MODELS

    async def reset_scene(self, request: pb.ResetSceneRequest) -> pb.ResetSceneResponse:
        self._note(request)
        return RESET

    async def watch_scene(self, request: pb.WatchSceneRequest) -> AsyncGenerator[pb.WatchSceneResponse]:
        self._note(request)
        queue: asyncio.Queue[pb.WatchSceneResponse | Exception | None] = asyncio.Queue()
        self._loop = asyncio.get_running_loop()
        with self._lock:
            self._queues.append(queue)
            self.watching += 1
        try:
            if not self.silent:
                yield pb.WatchSceneResponse()
            while (event := await queue.get()) is not None:
                if isinstance(event, Exception):
                    raise event
                yield event
        finally:
            with self._lock:
                self._queues.remove(queue)
                self.watching -= 1

    def end_watching(self) -> None:
        self.send(None)

    def send(self, event: pb.WatchSceneResponse | Exception | None) -> None:
        """Send all streams an event, an error that ends them, or None, their end."""
        with self._lock:
            for queue in self._queues:
                assert self._loop is not None
                self._loop.call_soon_threadsafe(queue.put_nowait, event)

    def wait(self, watching: int) -> None:
        """Wait until ``watching`` streams are open."""
        end = time.monotonic() + 10
        while self.watching != watching:
            assert time.monotonic() < end, f"{self.watching} watch"
            time.sleep(0.005)

    def _note(self, request: Message) -> None:
        self.asked.append(request)
        if self.error is not None:
            raise self.error


def with_fake_plane(server: Server) -> FakePlane:
    """Replace the server's consistency service by a fake."""
    plane = FakePlane()
    server.dataplane.consistency = plane
    return plane
