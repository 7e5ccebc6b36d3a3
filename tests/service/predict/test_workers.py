"""Worker processes: forwards as in the server's own process, and what a death costs."""

import os
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection

import numpy as np
import pytest
import torch

from model.checkpoint import load_checkpoint
from model.forecaster import Context, Forecaster, Prepared
from model.networks.forecaster import NetworkForecaster
from model.scenes.scene import AgentType
from service.predict.canary import straight_scene
from service.predict.forward import Batch, Forwarded, forward
from service.predict.workers import ARENA_BYTES, SharedChannel, Worker, WorkerDiedError
from service.settings import bundled_models
from tests.service.fakes import FakeForecaster

VEHICLE = AgentType.VEHICLE
SECONDS = 60.0


def bundled(name: str) -> NetworkForecaster:  # type: ignore[type-arg]
    folder = bundled_models()
    assert folder is not None
    forecaster = load_checkpoint(folder / name).forecaster()
    assert isinstance(forecaster, NetworkForecaster)
    return forecaster


@pytest.fixture(scope="module")
def cab() -> Forecaster:
    made = bundled("cab")
    made.compile(1)
    return made


@pytest.fixture
def deaths() -> list[int]:
    return []


@pytest.fixture
def worker(deaths: list[int]) -> Iterator[Worker]:
    made = Worker(0, 1, lambda: deaths.append(1))
    yield made
    made.close()


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def parts_of(forecaster: Forecaster, speeds: list[float], context: Context = Context.FULL) -> list[Prepared]:
    scene = straight_scene(VEHICLE, forecaster.info.history_frames, speeds)
    with torch.inference_mode():
        return [forecaster.view(scene, np.arange(len(speeds)), context)]


def run(worker: Worker, forecaster: Forecaster, parts: list[Prepared]) -> Forwarded:
    return worker.forward(forecaster, Batch(VEHICLE, Context.FULL, parts, 12))


def kill(worker: Worker) -> int:
    pid = worker.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    return pid


def same(one: Forwarded, other: Forwarded) -> bool:
    names = ("log_weights", "means", "covariances", "origin")
    pairs = [(getattr(one.mixture, name), getattr(other.mixture, name)) for name in names]
    return all(torch.equal(*pair) for pair in pairs)


@pytest.fixture
def channels() -> Iterator[tuple[SharedChannel, SharedChannel]]:
    one, other = socket.socketpair()
    memory = [os.memfd_create(name) for name in ("there", "back")]
    for number in memory:
        os.ftruncate(number, ARENA_BYTES)
    ends = (
        SharedChannel(Connection(one.detach()), memory[0], memory[1]),
        SharedChannel(Connection(other.detach()), memory[1], memory[0]),
    )
    yield ends
    for end in ends:
        end.close()
    for number in memory:
        os.close(number)


@pytest.mark.parametrize("rows", [0, 1, 1000])
def test_a_channel_returns_what_was_sent(channels: tuple[SharedChannel, SharedChannel], rows: int) -> None:
    there, back = channels
    values = np.arange(6.0 * rows).reshape(rows, 6)
    sent = {"whole": values, "every other": values[:, ::2], "tensor": torch.from_numpy(values).T, "text": "ß"}
    there.send(sent)
    received = back.receive()
    assert received["text"] == "ß"
    for name in ("whole", "every other", "tensor"):
        assert np.array_equal(np.asarray(received[name]), np.asarray(sent[name]))
    back.send(received["every other"])
    assert np.array_equal(there.receive(), values[:, ::2])


def test_arrays_that_the_memory_does_not_hold_are_sent_all_the_same(
    channels: tuple[SharedChannel, SharedChannel],
) -> None:
    there, back = channels
    large = np.ones(ARENA_BYTES + 1, dtype=np.uint8)
    sender = threading.Thread(target=there.send, args=(large,))
    sender.start()
    assert back.receive().sum() == ARENA_BYTES + 1
    sender.join()


def test_the_other_end_of_a_closed_channel_ends(channels: tuple[SharedChannel, SharedChannel]) -> None:
    there, back = channels
    there.close()
    with pytest.raises(EOFError):
        back.receive()


def test_a_worker_forecasts_as_the_server_does(worker: Worker, cab: Forecaster) -> None:
    worker.start([cab], cab, 16)
    parts = [*parts_of(cab, [0.0, 5.0, 9.0]), *parts_of(cab, [12.0])]
    here = forward(cab, Batch(VEHICLE, Context.FULL, parts, 12))
    before = run(worker, cab, parts)  # the process starts only now, so this ran here
    until(lambda: worker.is_ready)
    there = run(worker, cab, parts)
    assert same(here, before)
    assert same(here, there)
    after = run(worker, cab, parts_of(cab, [1.0]))
    assert same(there, here), "the memory of an answer was written anew"
    assert not torch.equal(after.mixture.means[0], there.mixture.means[0])
    assert there.started > before.started
    assert there.seconds > there.patches > 0


def test_a_model_that_comes_later_is_loaded_and_one_that_goes_is_forgotten(
    worker: Worker, cab: Forecaster
) -> None:
    worker.start([], cab, 16)
    until(lambda: worker.is_ready)
    parts = parts_of(cab, [5.0])
    first = run(worker, cab, parts)
    worker.forget([id(cab)])
    assert same(first, run(worker, cab, parts))


def test_other_forecasters_run_in_the_calling_thread(worker: Worker, cab: Forecaster) -> None:
    worker.start([], cab, 16)
    until(lambda: worker.is_ready)
    fake = FakeForecaster()
    run(worker, fake, [Prepared({"position": torch.zeros(2, 2), "velocity": torch.ones(2, 2)})])
    assert fake.batches


def test_a_forward_that_fails_fails_alone(worker: Worker, cab: Forecaster) -> None:
    worker.start([cab], cab, 16)
    until(lambda: worker.is_ready)
    (good,) = parts_of(cab, [5.0])
    bad = Prepared({name: tensor for name, tensor in good.features.items() if name != "history"}, good.views)
    with pytest.raises(RuntimeError, match="history"):
        run(worker, cab, [bad])
    pid = worker.pid
    run(worker, cab, [good])
    assert worker.pid == pid


def test_a_worker_that_dies_in_a_forward_costs_that_one_and_is_replaced(
    worker: Worker, cab: Forecaster, deaths: list[int]
) -> None:
    worker.start([cab], cab, 16)
    until(lambda: worker.is_ready)
    parts = parts_of(cab, [5.0, 8.0])
    expected = run(worker, cab, parts)
    pid = worker.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    with ThreadPoolExecutor(1) as thread:
        held = thread.submit(run, worker, cab, parts)
        time.sleep(0.2)
        assert not held.done()
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(WorkerDiedError, match="worker 0 died"):
            held.result(SECONDS)
    assert len(deaths) == 1
    assert same(expected, run(worker, cab, parts))  # in this process meanwhile
    until(lambda: worker.is_ready)
    assert worker.pid != pid
    assert same(expected, run(worker, cab, parts))


def test_a_worker_that_dies_between_forwards_costs_none(
    worker: Worker, cab: Forecaster, deaths: list[int]
) -> None:
    worker.start([cab], cab, 16)
    until(lambda: worker.is_ready)
    parts = parts_of(cab, [5.0])
    expected = run(worker, cab, parts)
    pid = kill(worker)
    until(lambda: not worker.is_ready)
    assert same(expected, run(worker, cab, parts))
    until(lambda: worker.is_ready)
    assert worker.pid != pid
    assert len(deaths) == 1


def test_a_worker_ends_with_its_server(cab: Forecaster) -> None:
    made = Worker(0, 1, lambda: None)
    made.start([cab], cab, 16)
    until(lambda: made.is_ready)
    pid = made.pid
    assert pid is not None
    for number in (signal.SIGINT, signal.SIGTERM):  # as a terminal sends it to the whole group
        os.kill(pid, number)
    run(made, cab, parts_of(cab, [5.0]))
    made.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_worker_that_is_closed_while_it_starts_leaves_no_process(cab: Forecaster) -> None:
    made = Worker(0, 1, lambda: None)
    made.start([cab], cab, 16)
    made.close()
    assert not made.is_ready
    assert made.pid is None
