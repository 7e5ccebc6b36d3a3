"""Admission: which calls are refused, which go first, and what is learned from earlier calls."""

import asyncio
from contextlib import ExitStack

import pytest

from service.errors import DeadlineExceeded, Overloaded
from service.predict.admission import Admission, Backlog, Call, Margin
from service.telemetry.metrics import Metrics

FAR = 1e12
RATE = 1000.0
"""agents/s"""


def make(max_queue: int = 1000, max_batch: int = 64) -> Admission:
    """Return an admission that knows the costs of forwards, with a model that is busy for 10 ms more."""
    admission = Admission(max_batch, max_queue, Metrics())
    for agents in (1, 8, 64, 512):
        admission.costs.measure("model", agents, agents / RATE)
    admission.busy_until = now() + 0.01
    return admission


def now() -> float:
    return asyncio.get_running_loop().time()


def refused(admission: Admission, reason: str) -> float:
    value = admission._metrics.registry.get_sample_value("forecast_refused_total", {"reason": reason})
    return value or 0.0


async def settle() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


class Calls:
    """Calls in progress until the end of a block."""

    def __init__(self, admission: Admission) -> None:
        self.admission = admission
        self.stack = ExitStack()
        self.tasks: list[asyncio.Task[None]] = []

    def __enter__(self) -> "Calls":
        return self

    def __exit__(self, *_: object) -> None:
        for task in self.tasks:
            task.cancel()
        self.stack.close()

    def begin(self, agents: int, seconds: float = 1e6, priority: int = 0) -> Call:
        call = self.admission.admit(now() + seconds)
        self.stack.enter_context(self.admission.in_progress(call, agents, priority))
        return call

    def wait(self, agents: int, seconds: float = 1e6, priority: int = 0) -> "asyncio.Task[None]":
        task = asyncio.create_task(self.admission.turn(self.begin(agents, seconds, priority)))
        self.tasks.append(task)
        return task


def call(deadline: float, agents: int, priority: int = 0) -> Call:
    made = Call(deadline)
    made.agents, made.work, made.priority = agents, agents / RATE, priority
    return made


async def test_a_call_that_would_be_late_is_refused() -> None:
    admission = make()
    with Calls(admission) as calls:
        calls.begin(200, seconds=0.45)
        with pytest.raises(Overloaded) as caught:  # as large as the call before
            admission.admit(now() + 0.46)
        assert caught.value.retry_after == pytest.approx(0.2, rel=0.2)
        assert refused(admission, "late") == 1
        assert admission.admit(now() + 1.0)
    assert admission.waiting == 0


async def test_a_free_model_tries_a_call_a_second_that_is_expected_to_be_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    admission = make()
    admission.busy_until = None
    with pytest.raises(Overloaded):
        admission.admit(now())  # its deadline has passed: nothing can be learned from it
    monkeypatch.setattr("service.predict.admission._TRIAL_SECONDS", 0.0)
    with Calls(admission) as calls:
        tried = calls.begin(500, seconds=0.1)
        await admission.turn(tried)
    monkeypatch.setattr("service.predict.admission._TRIAL_SECONDS", 1000.0)
    with Calls(admission) as calls, pytest.raises(Overloaded):
        calls.begin(500, seconds=0.1)


async def test_no_margin_keeps_a_call_from_a_free_model() -> None:
    admission = make()
    for _ in range(100):
        admission._margin.measure(0.1, 0.3)
    assert admission._margin.factor > 2
    with pytest.raises(Overloaded), Calls(admission) as calls:  # of 64 agents, expected to take 64 + 10 ms
        calls.begin(64, seconds=0.1)
    admission.busy_until = None
    admission._tried = now()  # no trial
    with Calls(admission) as calls:
        calls.begin(64, seconds=0.1)
        with pytest.raises(Overloaded):  # behind the first one
            calls.begin(64, seconds=0.2)


async def test_work_that_goes_later_is_no_wait() -> None:
    admission = make()
    with Calls(admission) as calls:
        calls.begin(900, seconds=1e3)
        calls.begin(1, seconds=0.1)


async def test_a_size_that_is_known_may_refuse_what_was_admitted() -> None:
    admission = make()
    with Calls(admission) as calls:
        calls.begin(1)
        late = admission.admit(now() + 0.2)
        with pytest.raises(Overloaded), admission.in_progress(late, 400):
            pytest.fail("it is refused")
        assert admission.waiting == 1


async def test_a_new_call_is_expected_to_be_as_small_as_the_last_ones() -> None:
    admission = make()
    with Calls(admission) as calls:
        calls.begin(200, seconds=0.45)
        with pytest.raises(Overloaded):
            admission.admit(now() + 0.46)
        calls.begin(1, seconds=1e3)
        assert admission.admit(now() + 0.46)
        for _ in range(32):
            calls.begin(20, seconds=1e4)
        assert admission.admit(now() + 0.46)


async def test_a_full_queue_refuses() -> None:
    admission = make(max_queue=20)
    with Calls(admission) as calls:
        calls.begin(19)
        calls.begin(1)
        with pytest.raises(Overloaded):
            calls.begin(1)
        assert refused(admission, "queue_full") == 1


async def test_turns_are_given_by_priority_and_deadline() -> None:
    admission = make(max_batch=10)
    with Calls(admission) as calls:
        planned = [calls.begin(10) for _ in range(3)]
        for one in planned[:2]:
            await admission.turn(one)
        turns = [calls.wait(10, 1e5), calls.wait(10, 1e4), calls.wait(10, 1e5, priority=1)]
        given: list[int] = []
        for number, turn in enumerate(turns):
            turn.add_done_callback(lambda _, number=number: given.append(number))  # type: ignore[misc]
        await settle()
        assert given == []
        admission.release(planned[0], 10)
        await settle()
        assert given == [2]
        for one in (planned[1], *calls_with_turns(admission)):
            admission.release(one, 10)
            await settle()
        assert given == [2, 1, 0]


def calls_with_turns(admission: Admission) -> list[Call]:
    return [each for each in admission._backlog._calls if each.share]


async def test_small_calls_need_not_wait_for_all_of_a_large_one() -> None:
    admission = make(max_batch=10)
    with Calls(admission) as calls:
        large = calls.begin(500)
        await admission.turn(large)
        small = [calls.wait(1) for _ in range(10)]
        await settle()
        assert all(task.done() for task in small)
        beyond = calls.wait(1)
        await settle()
        assert not beyond.done()
        admission.release(large, 495)
        await settle()
        assert beyond.done()


async def test_a_call_that_has_become_late_never_gets_a_turn() -> None:
    admission = make(max_batch=10)
    with Calls(admission) as calls:
        planned = [calls.begin(10) for _ in range(2)]
        for one in planned:
            await admission.turn(one)
        late, possible = calls.wait(5, seconds=0.06), calls.wait(5)
        await asyncio.sleep(0.06)
        admission.release(planned[0], 10)
        await settle()
        with pytest.raises(DeadlineExceeded):
            await late
        assert possible.done()
        assert refused(admission, "dropped") == 1


async def test_a_higher_priority_displaces_what_waits() -> None:
    admission = make(max_queue=40, max_batch=10)
    with Calls(admission) as calls:
        for _ in range(2):
            await admission.turn(calls.begin(10))
        first, second = calls.wait(10, 1e4), calls.wait(10, 1e5)
        await settle()
        with pytest.raises(Overloaded):
            calls.begin(1)
        # The first call of a priority finds room for itself only after it has been read
        important = Call(FAR)
        calls.stack.enter_context(admission.in_progress(important, 5, priority=3))
        with pytest.raises(Overloaded):
            await second
        assert not first.done()
        assert refused(admission, "displaced") == 1
        calls.begin(5, priority=3)
        calls.begin(5, priority=3)
        with pytest.raises(Overloaded):
            await first
        # Calls that have had their turn stay
        calls.begin(5, priority=3)
        with pytest.raises(Overloaded, match="are queued"):
            calls.begin(5, priority=3)


async def test_cancelled_calls_leave() -> None:
    admission = make(max_batch=10)
    with Calls(admission) as calls:
        planned = [calls.begin(10) for _ in range(2)]
        for one in planned:
            await admission.turn(one)
        gone, stays = calls.wait(10), calls.wait(10)
        await settle()
        gone.cancel()
        await settle()
        admission.release(planned[0], 10)
        await settle()
        assert stays.done()
    assert (admission.waiting, admission._planned, len(admission._backlog)) == (0, 0, 0)


def test_the_speed_counts_work_not_calls() -> None:
    backlog = Backlog()
    assert backlog.seconds(1.0) == 1.0
    for number in range(20):  # calls of 0.5 s of work take half of that, because they share batches
        large = call(10.0 + number, 500)
        backlog.begin(large, 0.25 * number)
        backlog.end(large, 0.25 * number + 0.25, finished=True)
    assert backlog.seconds(0.001) == pytest.approx(0.0005)
    assert backlog.seconds(0.5) == pytest.approx(0.25)


def test_unfinished_calls_cost_time() -> None:
    backlog = Backlog()
    for number in range(20):
        lost, done = call(1.0 + number, 1000), call(1.0 + number, 1000)
        for one in (lost, done):
            backlog.begin(one, 2.0 * number)
        backlog.end(lost, 2.0 * number + 0.5, finished=False)
        backlog.end(done, 2.0 * number + 2.0, finished=True)
    assert backlog.seconds(1.0) == pytest.approx(2.0)


def test_time_without_calls_is_no_time_of_an_answer() -> None:
    backlog = Backlog()
    for start in (0.0, 100.0):
        one = call(start + 1, 1000)
        backlog.begin(one, start)
        backlog.end(one, start + 0.2, finished=True)
    assert backlog.seconds(1.0) == pytest.approx(0.2)


def test_work_before_a_call() -> None:
    backlog = Backlog()
    for deadline, agents, priority in ((1.0, 1000, 0), (2.0, 2000, 0), (3.0, 4000, 1)):
        backlog.begin(call(deadline, agents, priority), 0.0)

    def before(priority: int, deadline: float) -> float:
        return backlog.work_before((-priority, deadline))

    assert [before(0, 0.5), before(0, 1.5), before(0, 9.0)] == [4, 5, 7]
    assert [before(1, 2.0), before(1, 9.0), before(2, 9.0)] == [0, 4, 0]
    assert backlog.work_before() == 7


async def test_large_calls_are_not_refused_because_a_small_one_took_long() -> None:
    admission = make(max_queue=10**4)
    first = admission.admit(FAR)
    with admission.in_progress(first, 1):
        first.helper_seconds = 0.02
    admission.costs.measure_around(1, 0.02, 0.0)
    with Calls(admission) as calls:
        for _ in range(3):
            calls.begin(500, seconds=10.0)


def test_the_margin_follows_what_calls_took() -> None:
    steady, scattered, slow = Margin(), Margin(), Margin()
    first = steady.factor
    assert first > 1
    for number in range(200):
        steady.measure(0.1, 0.1)
        scattered.measure(0.1, 0.06 if number % 2 else 0.14)
        slow.measure(0.1, 0.2)
    assert 1.0 <= steady.factor < first < scattered.factor < slow.factor * 1.2
    assert slow.factor == pytest.approx(2.0, rel=0.05)
    for _ in range(200):
        slow.measure(0.1, 0.05)
    assert slow.factor == pytest.approx(0.5, rel=0.1)
