"""Schedules, and calls that keep to them whatever becomes of earlier ones."""

import asyncio
import time
from collections.abc import Awaitable, Callable

import numpy as np
import pytest

from loadtest.generator import SAMPLED, Generator, Load, even, poisson
from loadtest.requests import Request, made_up_requests
from loadtest.wire import Reply


class FakeWire:
    """Connection whose replies a test makes."""

    def __init__(self, reply: Callable[[int], Awaitable[Reply]]) -> None:
        self._reply = reply
        self.time_left: list[float | None] = []
        self.open = 0
        self.most_open = 0

    async def call(self, body: bytes, time_left: float | None) -> Reply:
        self.time_left.append(time_left)
        self.open += 1
        self.most_open = max(self.most_open, self.open)
        try:
            return await self._reply(len(self.time_left) - 1)
        finally:
            self.open -= 1

    async def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def requests() -> list[Request]:
    return made_up_requests("kalman", agents=1, scenes=2)


async def quick(_: int) -> Reply:
    return Reply("OK", b"answer")


def test_schedules_have_the_expected_number_of_calls_in_order() -> None:
    for schedule in (even, poisson):
        times = schedule(50.0, 4.0, 1.0)
        assert len(times) == 200
        assert (np.diff(times) >= 0).all()
        assert times.min() >= 1
        assert times.max() <= 5
    assert np.std(np.diff(poisson(50.0, 4.0))) > 10 * np.std(np.diff(even(50.0, 4.0)))


async def test_an_open_loop_does_not_wait_for_answers(requests: list[Request]) -> None:
    released = asyncio.Event()

    async def reply(number: int) -> Reply:
        if number == 19:
            released.set()
        await released.wait()
        return Reply("OK", b"answer")

    wire = FakeWire(reply)
    calls = await Generator(wire, requests).open_loop(Load(even(100.0, 0.2), 0.2))
    assert wire.most_open == 20
    assert [call.request for call in calls.all] == [0, 1] * 10
    assert calls.seconds >= 0.2


async def test_latency_counts_from_the_scheduled_time(requests: list[Request]) -> None:
    async def reply(number: int) -> Reply:
        if number == 0:
            time.sleep(0.3)  # noqa: ASYNC251 - nothing can be sent meanwhile
        return Reply("OK", b"answer")

    calls = await Generator(FakeWire(reply), requests).open_loop(Load(even(100.0, 0.2), 0.2, deadline=10.0))
    assert all(call.seconds >= 0.3 - call.scheduled - 0.05 for call in calls.all)
    assert calls.all[10].sent - calls.all[10].scheduled > 0.1


async def test_the_server_is_told_what_is_left_of_the_deadline(requests: list[Request]) -> None:
    wire = FakeWire(quick)
    await Generator(wire, requests).open_loop(Load(even(50.0, 0.1), 0.1, deadline=5.0))
    assert all(left is not None and 0 < left <= 5.0 for left in wire.time_left)


async def test_a_closed_loop_has_as_many_calls_as_clients(requests: list[Request]) -> None:
    wire = FakeWire(lambda _: asyncio.sleep(0.01, Reply("OK", b"answer")))
    calls = await Generator(wire, requests).closed_loop(3, 0.1)
    assert wire.most_open == 3
    assert len(calls.all) >= 3
    assert wire.time_left == [None] * len(calls.all)


async def test_refused_calls_are_sent_again_until_they_are_answered(requests: list[Request]) -> None:
    async def reply(number: int) -> Reply:
        return Reply("OK", b"answer") if number >= 4 else Reply("UNAVAILABLE")

    wire = FakeWire(reply)
    calls = await Generator(wire, requests).open_loop(Load(even(20.0, 0.1), 0.1, 1.0, retry_for=30.0))
    assert [call.code for call in calls.all] == ["OK", "OK"]
    wire = FakeWire(reply)
    calls = await Generator(wire, requests).open_loop(Load(even(20.0, 0.1), 0.1, 1.0))
    assert [call.code for call in calls.all] == ["UNAVAILABLE", "UNAVAILABLE"]


async def test_a_share_of_the_calls_is_cancelled(requests: list[Request]) -> None:
    async def reply(_: int) -> Reply:
        await asyncio.sleep(0.5)
        return Reply("OK", b"answer")

    load = Load(even(500.0, 0.2), 0.2, cancelled=0.3, cancel_within=0.01)
    calls = await Generator(FakeWire(reply), requests).open_loop(load)
    codes = [call.code for call in calls.all]
    assert codes.count("OK") + codes.count("CANCELLED") == 100
    assert 10 < codes.count("CANCELLED") < 60


async def test_a_sample_of_the_answers_is_kept(requests: list[Request]) -> None:
    calls = await Generator(FakeWire(quick), requests).open_loop(Load(even(2000.0, 0.2), 0.2))
    kept = [number for number, call in enumerate(calls.all) if call.body]
    assert len(kept) == SAMPLED
    assert max(kept) > 200  # not only the first
