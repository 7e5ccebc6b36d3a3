"""A server with worker processes: it answers as without them, and what the death of one costs."""

import asyncio
import os
import shutil
import signal
from collections import Counter
from pathlib import Path

import psutil
from grpc.aio import AioRpcError

from service.server import Server
from tests.model.checkpoints import copy_bundled
from tests.service.requests import make_request
from tests.service.servers import call_grpc, settings, until
from tests.service.test_reload import SMALL, reload


def serving(folder: Path, workers: int) -> Server:
    copy_bundled(folder / "one", SMALL)
    return Server(settings(models=folder, default_model=SMALL, threads=2, workers=workers))


def value(server: Server, name: str) -> float:
    found = server.metrics.registry.get_sample_value(name)
    assert found is not None
    return found


def pids(server: Server) -> list[int]:
    return [worker.pid for worker in server.dataplane._batcher._workers if worker.pid is not None]


async def started(server: Server, workers: int) -> None:
    await server.start()
    await until(lambda: value(server, "forecast_workers") == workers)


async def test_answers_are_those_of_a_server_without_workers(tmp_path: Path) -> None:
    request = make_request(3, model=SMALL)
    answers = []
    for workers in (0, 2):
        server = serving(tmp_path / str(workers), workers)
        await started(server, workers)
        try:
            answer = await call_grpc(server, request)
            answer.ClearField("timing")
            answers.append(answer)
        finally:
            await server.stop()
    assert answers[0] == answers[1]


async def test_the_death_of_a_worker_costs_the_calls_that_it_held(tmp_path: Path) -> None:
    server = serving(tmp_path, 2)
    await started(server, 2)
    outcomes: Counter[str] = Counter()
    over = asyncio.Event()

    async def keep_calling(agents: int) -> None:
        while not over.is_set():
            try:
                await call_grpc(server, make_request(agents, model=SMALL))
            except AioRpcError as error:
                outcomes[error.code().name] += 1
            else:
                outcomes["OK"] += 1

    clients = 6
    callers = [asyncio.create_task(keep_calling(1 + number)) for number in range(clients)]
    try:
        await until(lambda: outcomes["OK"] > 20)
        before = pids(server)
        os.kill(before[0], signal.SIGKILL)
        await until(lambda: value(server, "forecast_worker_deaths_total") == 1)
        answered = outcomes["OK"]
        await until(lambda: outcomes["OK"] > answered + 20)  # meanwhile, too
        await until(lambda: value(server, "forecast_workers") == 2)
        answered = outcomes["OK"]
        await until(lambda: outcomes["OK"] > answered + 20)
        assert before[0] not in pids(server)
        assert before[1] in pids(server)
        assert set(outcomes) <= {"OK", "INTERNAL"}
        assert outcomes["INTERNAL"] <= clients  # those that shared its batch
    finally:
        over.set()
        await asyncio.gather(*callers)
        left = pids(server)
        await server.stop()
    assert not any(psutil.pid_exists(pid) for pid in left)


async def test_models_that_are_loaded_later_run_in_the_workers_too(tmp_path: Path) -> None:
    server = serving(tmp_path, 2)
    await started(server, 2)
    try:
        old = await call_grpc(server, make_request(2, model=SMALL))
        copy_bundled(tmp_path / "two", SMALL, "99.0.0")
        shutil.rmtree(tmp_path / "one")
        response = await reload(server)
        assert [model.version for model in response.loaded] == ["99.0.0"]
        new = await call_grpc(server, make_request(2, model=SMALL))
        assert new.model.version == "99.0.0"
        assert new.forecasts[0].means == old.forecasts[0].means  # the same weights
        for worker in server.dataplane._batcher._workers:
            await until(lambda worker=worker: len(worker._models) == 1)  # type: ignore[misc]
    finally:
        await server.stop()
