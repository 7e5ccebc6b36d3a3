"""Replay of the planned calls through an endpoint, several at a time; answers are saved."""

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from benchmark.archive import Answer, Archive
from benchmark.errors import BenchmarkError
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
"""Retries of a call; in practice its timeout ends them."""
MAX_REFUSED = 100
"""Refused calls in a row that end a replay."""


@dataclass
class Replayed:
    """Outcome of a replay."""

    requested: int = 0
    """Forecasts requested by this replay; saved answers are not requested again."""
    seconds: float = 0.0
    refused: int = 0
    """Calls that the endpoint refused."""
    in_a_row: int = 0
    """Refused calls since the last answer."""


@dataclass(frozen=True)
class Replay:
    """Calls to an endpoint."""

    scenes: Sequence[PlannedScene]
    models: Mapping[str, Model]
    """Values by ``name@version``."""
    protocol: Protocol
    concurrency: int = 16
    """Maximum number of concurrent calls."""
    timeout: float = 60.0
    """Seconds for a call with its retries; also the time that a lost server is waited for."""

    def forecasts(self) -> int:
        """Return the total number of forecasts: one per agent, frame and model."""
        return len(self.models) * sum(scene.forecasts for scene in self.scenes)

    async def run(self, client: AsyncClient, archive: Archive, tick: Callable[[int], None]) -> Replayed:
        """Make all calls that have no saved answer.

        Overload, missed deadlines and lost connections are retried. A call that the endpoint refuses or
        fails is recorded and skipped. ``MAX_REFUSED`` of these in a row, or any other error, end the replay;
        answers so far are kept.

        Args:
            client: client of the endpoint.
            archive: the saved answers.
            tick: called with the number of forecasts of every call, saved ones included.

        Raises:
            BenchmarkError: the endpoint does not answer, or refuses too many calls.
        """
        done = archive.answered()
        replayed = Replayed()
        started = time.perf_counter()
        work = self._work(done, tick)
        # Senders take calls from one iterator: there is no queue that could grow
        senders = [
            asyncio.create_task(self._send(work, client, archive, replayed, tick))
            for _ in range(self.concurrency)
        ]
        try:
            await asyncio.gather(*senders)
        except (Unavailable, Overloaded, DeadlineExceeded) as error:
            raise BenchmarkError(
                f"the endpoint does not answer: {error}; answers so far are kept, run again to continue"
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
                if replayed.in_a_row >= MAX_REFUSED:
                    raise
            else:
                replayed.in_a_row = 0
                seconds = time.perf_counter() - started
                keep_most_likely(response, call, scene)
                archive.add(model, scene.record.name, call, Answer(seconds, response))
            replayed.requested += len(call.tracks)
            tick(len(call.tracks))

    async def _predict(self, client: AsyncClient, request: PredictRequest) -> PredictResponse:
        """Make one call.

        A server may have a shorter deadline of its own: missed deadlines are retried while time remains.
        """
        budget = Budget(self.timeout)
        while True:
            try:
                return await client.predict(request, timeout=budget.remaining())
            except DeadlineExceeded:
                budget.remaining()  # raises when no time is left

    def _work(
        self, done: set[tuple[str, str, int]], tick: Callable[[int], None]
    ) -> Iterator[tuple[str, PlannedScene, Call, PredictRequest]]:
        """Yield the calls without an answer, scene by scene, each with its request."""
        frames = max(model.history_frames for model in self.models.values())
        for scene in self.scenes:
            requests = SceneRequests(scene, self.protocol, frames)
            for call in scene.calls:
                pending = [m for m in self.models if (m, scene.record.name, call.frame) not in done]
                tick(len(call.tracks) * (len(self.models) - len(pending)))
                if not pending:
                    continue
                request = requests.request(call)
                for model in pending:
                    named = PredictRequest()
                    named.CopyFrom(request)
                    named.model = model
                    yield model, scene, call, named


def keep_most_likely(response: PredictResponse, call: Call, scene: PlannedScene) -> None:
    """Reduce forecasts that are no challenge pairs to their most likely mode, in place.

    Dispersion and convergence need no other mode, and the response shrinks to a twentieth. It is then as the
    endpoint would have given it with ``max_modes`` = 1.
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
        forecast.mode_ids[:] = forecast.mode_ids[mode : mode + 1]  # optional in a response
        forecast.weights[:] = [weight]
        forecast.most_likely_mode = 0
