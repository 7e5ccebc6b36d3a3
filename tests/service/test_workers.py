"""A server with worker processes: it answers as without them, and what the death of one costs."""

import asyncio
import os
import shutil
import signal
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import psutil

from service.server import Server
from tests.model.checkpoints import copy_bundled
from tests.service.requests import make_request
from tests.service.servers import CallError, call_grpc, settings, until
from tests.service.test_reload import SMALL, reload

SECONDS = 60.0


def value(server: Server, name: str) -> float:
    found = server.metrics.registry.get_sample_value(name)
    assert found is not None
    return found


def pids(server: Server) -> list[int]:
    return [worker.pid for worker in server.dataplane._batcher._workers if worker.pid is not None]


@asynccontextmanager
async def serving(folder: Path, workers: int) -> AsyncIterator[Server]:
    copy_bundled(folder / "one", SMALL)
    server = Server(settings(models=folder, default_model=SMALL, threads=2, workers=workers))
    await server.start()
    try:
        await until(lambda: value(server, "forecast_workers") == workers, SECONDS)
        yield server
    finally:
        await server.stop()


async def test_answers_are_those_of_a_server_without_workers(tmp_path: Path) -> None:
    request = make_request(3, model=SMALL)
    answers = []
    for workers in (0, 2):
        async with serving(tmp_path / str(workers), workers) as server:
            answer = await call_grpc(server, request)
            answer.ClearField("timing")
            answers.append(answer)
    assert answers[0] == answers[1]


async def test_the_death_of_a_worker_costs_the_calls_that_it_held(tmp_path: Path) -> None:
    outcomes: Counter[str] = Counter()
    over = asyncio.Event()

    async def keep_calling(server: Server, agents: int) -> None:
        while not over.is_set():
            try:
                await call_grpc(server, make_request(agents, model=SMALL))
            except CallError as error:
                outcomes[error.code] += 1
            else:
                outcomes["OK"] += 1

    async def twenty_more() -> None:
        answered = outcomes["OK"]
        await until(lambda: outcomes["OK"] > answered + 20, SECONDS)

    clients = 6
    async with serving(tmp_path, 2) as server:
        callers = [asyncio.create_task(keep_calling(server, 1 + number)) for number in range(clients)]
        try:
            await twenty_more()
            before = pids(server)
            os.kill(before[0], signal.SIGKILL)
            await until(lambda: value(server, "forecast_worker_deaths_total") == 1, SECONDS)
            await twenty_more()  # meanwhile, too
            await until(lambda: value(server, "forecast_workers") == 2, SECONDS)
            await twenty_more()
            left = pids(server)
            assert before[0] not in left
            assert before[1] in left
        finally:
            over.set()
            await asyncio.gather(*callers)
    assert set(outcomes) <= {"OK", "INTERNAL"}
    assert outcomes["INTERNAL"] <= clients  # those that shared its batch
    assert not any(psutil.pid_exists(pid) for pid in left)


async def test_models_that_are_loaded_later_run_in_the_workers_too(tmp_path: Path) -> None:
    async with serving(tmp_path, 2) as server:
        old = await call_grpc(server, make_request(2, model=SMALL))
        copy_bundled(tmp_path / "two", SMALL, "99.0.0")
        shutil.rmtree(tmp_path / "one")
        response = await reload(server)
        assert [model.version for model in response.loaded] == ["99.0.0"]
        new = await call_grpc(server, make_request(2, model=SMALL))
        assert new.model.version == "99.0.0"
        assert new.forecasts[0].means == old.forecasts[0].means  # the same weights
        for worker in server.dataplane._batcher._workers:
            await until(lambda worker=worker: len(worker._models) == 1, SECONDS)  # type: ignore[misc]
