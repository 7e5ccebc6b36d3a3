"""Guard and circuit breaker: results, metrics, and calls that nobody waits for."""

import asyncio
import gc
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from typing import Any

import pytest
from redis import exceptions as redis_errors
from structlog.testing import capture_logs

from loadtest.redis_servers import FaultProxy
from service.redis_url import parse_address
from service.tracking.store.base import StoreError
from service.tracking.store.guard import CircuitBreaker, Guard
from service.tracking.store.redis.connection import connect

LONG = 30.0
"""Budget that is never exceeded, s."""
SHORT = 0.001
"""Budget that is always exceeded, s."""


class Watched:
    """Guard and its metrics."""

    def __init__(self, **options: Any) -> None:
        self.now = 0.0
        self.times: list[tuple[str, float]] = []
        self.failures: Counter[tuple[str, str]] = Counter()
        self.guard = Guard(
            lambda op, seconds: self.times.append((op, seconds)),
            lambda op, reason: self.failures.update([(op, reason)]),
            clock=lambda: self.now,
            **options,
        )

    async def fail(self, error: Exception | None = None) -> None:
        """Make one call that fails."""
        with pytest.raises(StoreError):
            await self.guard.run("read", raising(error or redis_errors.ConnectionError()), LONG)

    async def open_circuit(self) -> None:
        """Make enough failing calls."""
        for _ in range(3):
            await self.fail()
        self.failures.clear()


class Held:
    """Call that ends when the test releases it."""

    def __init__(self, error: Exception | None = None) -> None:
        self.begun = asyncio.Event()
        self.release = asyncio.Event()
        self.cancelled = False
        self._error = error

    async def __call__(self) -> str:
        self.begun.set()
        try:
            await self.release.wait()
        except asyncio.CancelledError:
            self.cancelled = True
            raise
        if self._error is not None:
            raise self._error
        return "answer"


def raising(error: BaseException) -> Callable[[], Awaitable[None]]:
    async def call() -> None:
        raise error

    return call


async def answer() -> str:
    return "answer"


async def until_idle(guard: Guard) -> None:
    """Wait until no call is in progress."""
    async with asyncio.timeout(10):
        while guard.outstanding:  # noqa: ASYNC110 - no event tells
            await asyncio.sleep(0)
    await asyncio.sleep(0)  # what hears of their ends


@pytest.fixture
def watched() -> Watched:
    return Watched()


async def test_a_result_is_passed_on(watched: Watched) -> None:
    assert await watched.guard.run("read", answer, LONG) == "answer"
    ((op, seconds),) = watched.times
    assert op == "read"
    assert 0 <= seconds < 10
    assert not watched.failures
    assert watched.guard.outstanding == 0


async def test_over_its_budget_a_call_goes_on_alone(watched: Watched) -> None:
    call, late = Held(), list[str]()
    with pytest.raises(StoreError, match="in time"):
        await watched.guard.run("exchange", call, SHORT, late.append)
    assert watched.failures == {("exchange", "timeout"): 1}
    assert watched.guard.outstanding == 1
    assert not watched.times
    call.release.set()
    await until_idle(watched.guard)
    assert late == ["answer"]
    assert not call.cancelled
    assert watched.failures == {("exchange", "timeout"): 1}
    assert [op for op, _ in watched.times] == ["exchange"]


async def test_a_caller_in_a_hurry_blames_nobody(watched: Watched) -> None:
    may_end = asyncio.Event()

    async def call() -> str:
        await may_end.wait()
        return "late"

    late: list[str] = []
    for _ in range(5):
        with pytest.raises(StoreError):
            await watched.guard.run("exchange", call, LONG, late.append, time_left_s=SHORT)
    may_end.set()
    assert await watched.guard.run("exchange", call, LONG) == "late"  # the circuit is closed
    await asyncio.sleep(0)
    assert not watched.failures
    assert late == ["late"] * 5


async def test_a_reply_that_is_there_counts_though_the_loop_was_busy(watched: Watched) -> None:
    async def call() -> str:
        time.sleep(0.05)  # noqa: ASYNC251 - just that is meant
        for _ in range(3):
            await asyncio.sleep(0)
        return "answer"

    assert await watched.guard.run("read", call, SHORT) == "answer"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (TimeoutError(), "timeout"),
        (redis_errors.TimeoutError("10.0.0.1"), "timeout"),
        (redis_errors.ConnectionError("10.0.0.1"), "refused"),
        (ConnectionResetError("10.0.0.1"), "refused"),
        (redis_errors.MaxConnectionsError("10.0.0.1"), "saturated"),
        (redis_errors.BusyLoadingError("10.0.0.1"), "loading"),
        (redis_errors.AuthenticationError("10.0.0.1"), "denied"),
        (redis_errors.NoPermissionError("10.0.0.1"), "denied"),
        (redis_errors.OutOfMemoryError("10.0.0.1"), "out_of_memory"),
        (redis_errors.ReadOnlyError("10.0.0.1"), "readonly"),
        (redis_errors.ClusterDownError("10.0.0.1"), "cluster_down"),
        (redis_errors.RedisClusterException("10.0.0.1"), "cluster_down"),
        (redis_errors.SlotNotCoveredError("10.0.0.1"), "cluster_down"),
        (redis_errors.ResponseError("10.0.0.1"), "other"),
        (KeyError("10.0.0.1"), "other"),
    ],
)
async def test_errors_are_told_in_a_word(watched: Watched, error: Exception, reason: str) -> None:
    with pytest.raises(StoreError) as told:
        await watched.guard.run("read", raising(error), LONG)
    assert told.value.__cause__ is error
    assert "10.0.0.1" not in str(told.value)
    assert watched.failures == {("read", reason): 1}


async def test_a_store_error_stays_as_it_is(watched: Watched) -> None:
    error = StoreError("because")
    with pytest.raises(StoreError, match="because") as told:
        await watched.guard.run("read", raising(error), LONG)
    assert told.value is error
    assert watched.failures == {("read", "other"): 1}


async def test_no_more_calls_than_it_may_have_under_way() -> None:
    watched = Watched(max_outstanding=2, failures=100)
    calls = [Held(), Held()]
    for call in calls:
        with pytest.raises(StoreError):
            await watched.guard.run("read", call, SHORT)
    third = Held()
    with pytest.raises(StoreError, match="overloaded"):
        await watched.guard.run("read", third, LONG)
    assert not third.begun.is_set()
    assert watched.failures == {("read", "timeout"): 2, ("read", "saturated"): 1}
    for call in calls:
        call.release.set()
    await until_idle(watched.guard)
    assert await watched.guard.run("read", answer, LONG) == "answer"


async def test_failures_open_the_circuit_and_one_call_closes_it(watched: Watched) -> None:
    await watched.open_circuit()
    unmade = Held()
    with pytest.raises(StoreError, match="not called"):
        await watched.guard.run("read", unmade, LONG)
    assert not unmade.begun.is_set()
    assert watched.failures == {("read", "circuit_open"): 1}
    watched.now += 0.25
    probe = Held()
    deciding = asyncio.create_task(watched.guard.run("read", probe, LONG))
    await probe.begun.wait()
    with pytest.raises(StoreError, match="not called"):
        await watched.guard.run("read", unmade, LONG)
    probe.release.set()
    assert await deciding == "answer"
    assert await watched.guard.run("read", answer, LONG) == "answer"


async def test_calls_over_their_budget_open_the_circuit_though_they_succeed_late(watched: Watched) -> None:
    calls = [Held() for _ in range(3)]
    for call in calls:
        with pytest.raises(StoreError, match="in time"):
            await watched.guard.run("read", call, SHORT)
    for call in calls:
        call.release.set()
    await until_idle(watched.guard)
    with pytest.raises(StoreError, match="not called"):
        await watched.guard.run("read", answer, LONG)


async def test_a_server_that_refuses_at_once_is_asked_on(watched: Watched) -> None:
    for _ in range(10):
        await watched.fail(redis_errors.OutOfMemoryError())
        await watched.fail(redis_errors.ReadOnlyError())
    assert await watched.guard.run("read", answer, LONG) == "answer"


async def test_a_caller_that_goes_away_leaves_its_call(watched: Watched) -> None:
    call, late = Held(), list[str]()
    caller = asyncio.create_task(watched.guard.run("read", call, LONG, late.append))
    await call.begun.wait()
    caller.cancel()
    with pytest.raises(asyncio.CancelledError):
        await caller
    assert watched.guard.outstanding == 1
    call.release.set()
    await until_idle(watched.guard)
    assert late == ["answer"]
    assert not call.cancelled
    assert not watched.failures


@pytest.mark.parametrize("error", [None, redis_errors.ConnectionError()])
async def test_the_deciding_call_decides_though_its_caller_goes_away(
    watched: Watched, error: Exception | None
) -> None:
    await watched.open_circuit()
    watched.now += 0.25
    probe = Held(error)
    caller = asyncio.create_task(watched.guard.run("read", probe, LONG))
    await probe.begun.wait()
    caller.cancel()
    with pytest.raises(asyncio.CancelledError):
        await caller
    with pytest.raises(StoreError, match="not called"):
        await watched.guard.run("read", answer, LONG)
    probe.release.set()
    await until_idle(watched.guard)
    if error is None:
        assert await watched.guard.run("read", answer, LONG) == "answer"
    else:
        with pytest.raises(StoreError, match="not called"):
            await watched.guard.run("read", answer, LONG)
        assert watched.failures[("read", "refused")] == 1


async def test_a_left_call_that_ends_over_its_budget_has_failed(watched: Watched) -> None:
    call = Held()
    caller = asyncio.create_task(watched.guard.run("read", call, 0.02))
    await call.begun.wait()
    caller.cancel()
    with pytest.raises(asyncio.CancelledError):
        await caller
    await asyncio.sleep(0.05)
    call.release.set()
    await until_idle(watched.guard)
    assert watched.failures == {("read", "timeout"): 1}


async def test_errors_of_left_calls_are_noticed(watched: Watched) -> None:
    complaints: list[object] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: complaints.append(context))
    call, late = Held(redis_errors.ConnectionError()), list[str]()
    with pytest.raises(StoreError):
        await watched.guard.run("read", call, SHORT, late.append)
    call.release.set()
    await until_idle(watched.guard)
    gc.collect()
    assert not complaints
    assert not late
    assert watched.failures == {("read", "timeout"): 1}


async def test_closing_ends_what_does_not_end_by_itself(watched: Watched) -> None:
    quick, stuck = Held(), Held()
    for call in (quick, stuck):
        with pytest.raises(StoreError):
            await watched.guard.run("read", call, SHORT)
    waiting = asyncio.create_task(watched.guard.run("read", Held(), LONG))
    await asyncio.sleep(0)
    quick.release.set()
    await watched.guard.close(wait_s=0.05)
    assert watched.guard.outstanding == 0
    assert not quick.cancelled
    assert stuck.cancelled
    with pytest.raises(StoreError, match="stopping"):
        await waiting
    with pytest.raises(StoreError, match="stopping"):
        await watched.guard.run("read", answer, LONG)
    await watched.guard.close()


async def test_many_calls_at_once_against_a_network_that_hangs(redis_proxy: FaultProxy) -> None:
    watched = Watched(max_outstanding=8)
    client = connect(parse_address(redis_proxy.url), timeout_s=0.2, connections=4)

    async def call(budget_s: float) -> object:
        return await watched.guard.run("read", lambda: client.execute_command("ECHO", "here"), budget_s)

    try:
        assert await call(LONG) == b"here"
        redis_proxy.set("stall")
        started = time.perf_counter()
        results = await asyncio.gather(*(call(0.02) for _ in range(50)), return_exceptions=True)
        assert time.perf_counter() - started < 5
        assert all(isinstance(result, StoreError) for result in results)
        assert watched.failures == {("read", "timeout"): 8, ("read", "saturated"): 42}
        with pytest.raises(StoreError, match="not called"):
            await call(0.02)
        redis_proxy.set("pass")
        await until_idle(watched.guard)
        watched.now += 10
        assert await call(LONG) == b"here"
    finally:
        await watched.guard.close()
        await client.aclose()


class Clock:
    """Clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def circuit(clock: Clock) -> CircuitBreaker:
    return CircuitBreaker(failures=3, pause_s=0.25, max_pause_s=2.0, clock=clock)


def call(circuit: CircuitBreaker, success: bool) -> None:
    """Make a call that ends at once."""
    assert circuit.ready
    circuit.end(circuit.begin(), success)


def test_it_opens_after_failures_in_a_row(circuit: CircuitBreaker) -> None:
    for success in (False, False, True, False, False, True):
        call(circuit, success)
    for _ in range(3):
        call(circuit, False)
    assert not circuit.ready


def test_one_call_decides_after_the_pause(circuit: CircuitBreaker, clock: Clock) -> None:
    for _ in range(3):
        call(circuit, False)
    clock.now += 0.2499
    assert not circuit.ready
    clock.now += 0.0001
    assert circuit.ready
    probe = circuit.begin()
    assert probe
    assert not circuit.ready
    clock.now += 1000
    assert not circuit.ready
    circuit.end(probe, True)
    assert circuit.ready
    assert not circuit.begin()


def test_pauses_double_up_to_the_longest_and_begin_anew(circuit: CircuitBreaker, clock: Clock) -> None:
    for _ in range(3):
        call(circuit, False)
    for pause in (0.25, 0.5, 1.0, 2.0, 2.0):
        clock.now += pause - 0.0001
        assert not circuit.ready
        clock.now += 0.0001
        call(circuit, False)
    clock.now += 2.0
    call(circuit, True)
    for _ in range(3):
        call(circuit, False)
    clock.now += 0.25
    assert circuit.ready


def test_calls_from_before_it_opened_decide_nothing(circuit: CircuitBreaker, clock: Clock) -> None:
    old = [circuit.begin() for _ in range(6)]
    for probe in old[:3]:
        circuit.end(probe, False)
    clock.now += 0.2
    circuit.end(old[3], False)
    circuit.end(old[4], True)
    assert not circuit.ready
    clock.now += 0.05
    probe = circuit.begin()
    circuit.end(old[5], True)
    assert probe
    assert not circuit.ready


async def test_an_outage_is_logged_once_and_so_is_its_end() -> None:
    watched = Watched(calls="forecasts")
    with capture_logs() as logs:
        for _ in range(2):
            await watched.fail()
        assert logs == []  # one lost reply is no outage
        for _ in range(3):
            await watched.fail()
        for _ in range(3):  # failed probes
            watched.now += 10.0
            await watched.fail()
        [lost] = logs
        watched.now += 10.0
        for _ in range(3):
            await watched.guard.run("read", answer, LONG)
        _, back = logs
    assert lost == {
        "event": "track memory lost",
        "log_level": "warning",
        "calls": "forecasts",
        "reason": "refused",
        "circuit_open": True,
    }
    assert (back["event"], back["log_level"]) == ("track memory back", "warning")
    assert back["seconds"] >= 0


async def test_a_full_memory_is_an_outage_that_opens_no_circuit() -> None:
    watched = Watched()
    with capture_logs() as logs:
        for _ in range(6):
            await watched.fail(redis_errors.OutOfMemoryError())
        [lost] = logs
        await watched.guard.run("read", answer, LONG)
    assert (lost["reason"], lost["circuit_open"]) == ("out_of_memory", False)
    assert [entry["event"] for entry in logs] == ["track memory lost", "track memory back"]


async def test_the_first_check_is_logged_at_once() -> None:
    async def refuse() -> None:
        raise redis_errors.ConnectionError

    watched = Watched()
    with capture_logs() as logs:
        await watched.guard.check(refuse)
        await watched.fail()
    assert [entry["event"] for entry in logs] == ["track memory lost"]


async def test_a_first_check_that_succeeds_is_silent() -> None:
    async def respond() -> None:
        pass

    watched = Watched()
    with capture_logs() as logs:
        await watched.guard.check(respond)
        for _ in range(2):
            await watched.fail()
    assert logs == []
