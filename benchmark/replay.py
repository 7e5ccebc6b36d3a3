"""Sends the calls of a plan, several at a time, and keeps the answers."""

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from benchmark import BenchmarkError
from benchmark.archive import Answer, Archive
from benchmark.plan import Call, PlannedScene
from benchmark.requests import SceneRequests
from cab.forecast.v1.model_service_pb2 import Model
from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse
from cab_forecast import (
    AsyncClient,
    BadRequest,
    DeadlineExceeded,
    ForecastError,
    InternalError,
    Overloaded,
    TooLarge,
    Unavailable,
)
from cab_forecast.timing import Budget
from model.forecaster import Protocol

RETRIES = 10_000
"""Of a call: its timeout ends them."""
MOST_REFUSED = 100
"""Calls in a row; an endpoint that refuses so many will refuse the others, too."""


@dataclass
class Replayed:
    """How a replay went."""

    asked: int = 0
    """Forecasts that were asked for now; what was in the archive is not asked again."""
    seconds: float = 0.0
    refused: int = 0
    """Calls that the endpoint would not answer."""
    in_a_row: int = 0
    """Refused calls since the last answer."""


@dataclass(frozen=True)
class Replay:
    """What is sent, and how."""

    scenes: Sequence[PlannedScene]
    models: Mapping[str, Model]
    """By ``name@version``."""
    protocol: Protocol
    concurrency: int = 16
    """Calls on their way at once."""
    timeout: float = 60.0
    """s for a call with its retries: also how long a lost server is waited for."""

    def forecasts(self) -> int:
        """How many answers there will be: one an agent, frame and model."""
        return len(self.models) * sum(scene.forecasts for scene in self.scenes)

    async def run(self, client: AsyncClient, archive: Archive, tick: Callable[[int], None]) -> Replayed:
        """Asks whatever has no answer yet.

        Overload, late answers and lost connections are waited out. A call that the endpoint refuses or fails
        at is noted, and the next one made; many such in a row, and anything else, end the replay, with all
        answers kept.

        Args:
            client: of the endpoint.
            archive: of the answers.
            tick: told of every call how many forecasts it brought; first of what is there already.

        Raises:
            BenchmarkError: the endpoint does not answer, or refuses everything.
        """
        done = archive.answered()
        replayed = Replayed()
        started = time.perf_counter()
        work = self._work(done, tick)
        # Every sender takes the next call when it is through with one: no queue that could grow
        senders = [
            asyncio.create_task(self._send(work, client, archive, replayed, tick))
            for _ in range(self.concurrency)
        ]
        try:
            await asyncio.gather(*senders)
        except (Unavailable, Overloaded, DeadlineExceeded) as error:
            raise BenchmarkError(
                f"the endpoint does not answer: {error}; answers so far are kept, run again to go on"
            ) from error
        except ForecastError as error:
            raise BenchmarkError(f"the endpoint refuses: {error}; answers so far are kept") from error
        finally:
            for sender in senders:
                sender.cancel()
            await asyncio.gather(*senders, return_exceptions=True)
            replayed.seconds = time.perf_counter() - started
        return replayed

    async def _send(
        self,
        work: Iterator[tuple[str, PlannedScene, Call, PredictRequest]],
        client: AsyncClient,
        archive: Archive,
        replayed: Replayed,
        tick: Callable[[int], None],
    ) -> None:
        for model, scene, call, request in work:
            started = time.perf_counter()
            try:
                response = await self._predict(client, request)
            except (BadRequest, TooLarge, InternalError) as error:
                archive.refuse(model, scene.record.name, call, str(error))
                replayed.refused += 1
                replayed.in_a_row += 1
                if replayed.in_a_row >= MOST_REFUSED:
                    raise
            else:
                replayed.in_a_row = 0
                seconds = time.perf_counter() - started
                keep_the_likeliest(response, call, scene)
                archive.add(model, scene.record.name, call, Answer(seconds, response))
            replayed.asked += len(call.tracks)
            tick(len(call.tracks))

    async def _predict(self, client: AsyncClient, request: PredictRequest) -> PredictResponse:
        """One call. A server has bounds of its own for how long it takes: what it says is late is asked again
        while there is time."""
        budget = Budget(self.timeout)
        while True:
            try:
                return await client.predict(request, timeout=budget.remaining())
            except DeadlineExceeded:
                budget.remaining()  # raises when none is left

    def _work(
        self, done: set[tuple[str, str, int]], tick: Callable[[int], None]
    ) -> Iterator[tuple[str, PlannedScene, Call, PredictRequest]]:
        """Calls without an answer, scene by scene, each with its request."""
        frames = max(model.history_frames for model in self.models.values())
        for scene in self.scenes:
            requests = SceneRequests(scene, self.protocol, frames)
            for call in scene.calls:
                open_ = [m for m in self.models if (m, scene.record.name, call.frame) not in done]
                tick(len(call.tracks) * (len(self.models) - len(open_)))
                if not open_:
                    continue
                request = requests.request(call)
                for model in open_:
                    named = PredictRequest()
                    named.CopyFrom(request)
                    named.model = model
                    yield model, scene, call, named


def keep_the_likeliest(response: PredictResponse, call: Call, scene: PlannedScene) -> None:
    """Of forecasts that the challenge does not ask for, keeps the most likely mode alone.

    It is all that is looked at, and a twentieth of the size. The message is then as the endpoint would have
    given it with ``max_modes`` = 1.
    """
    due = {scene.record.tracks[track].id for track in call.due}
    steps = response.steps
    for forecast in response.forecasts:
        if forecast.agent_id in due or len(forecast.weights) <= 1:
            continue
        mode = forecast.most_likely_mode
        weight = forecast.weights[mode]
        forecast.remaining_weight += sum(forecast.weights) - weight
        for values, size in ((forecast.means, 2), (forecast.covariances, 3)):
            values[:] = values[mode * steps * size : (mode + 1) * steps * size]
        forecast.mode_ids[:] = forecast.mode_ids[mode : mode + 1]  # an endpoint may leave them out
        forecast.weights[:] = [weight]
        forecast.most_likely_mode = 0
