"""Batches: which calls share a forward, and what becomes of calls that fail or leave."""

import asyncio
from collections.abc import AsyncIterator, Callable
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from structlog.testing import capture_logs

from model.forecaster import Context, Features, Prepared
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentType
from service.errors import DeadlineExceeded, Internal, Overloaded, Unavailable
from service.predict.admission import Admission, Call
from service.predict.batcher import Batcher, Job, Outcome, seconds_in_model
from service.predict.torch_threads import ForwardThreads
from service.telemetry.metrics import Metrics
from tests.service.fakes import FakeForecaster

FAR = 1e12
VEHICLE, PEDESTRIAN = AgentType.VEHICLE, AgentType.PEDESTRIAN


@pytest.fixture
def admission() -> Admission:
    """At most 8 agents in a batch and 20 in the queue."""
    return Admission(8, 20, Metrics())


@pytest.fixture
async def batcher(admission: Admission) -> AsyncIterator[Batcher]:
    made = Batcher(8, admission, Metrics())
    made.start()
    yield made
    await made.stop()


@pytest.fixture
def fake() -> FakeForecaster:
    """Holds its forwards back until the test lets them go."""
    forecaster = FakeForecaster()
    forecaster.free.clear()
    return forecaster


def features(agents: int, x: float = 0.0) -> Features:
    position = torch.zeros(agents, 2, dtype=torch.float64)
    position[:, 0] = x + torch.arange(agents)
    return {"position": position, "velocity": torch.ones(agents, 2, dtype=torch.float64)}


def job(
    fake: FakeForecaster,
    agents: int,
    kind: AgentType = VEHICLE,
    context: Context = Context.FULL,
    steps: int = 12,
    x: float = 0.0,
) -> Job:
    return Job(fake, kind, context, Prepared(features(agents, x)), steps)


def submit(
    batcher: Batcher, *jobs: Job, deadline: float = FAR, priority: int = 0
) -> "asyncio.Task[list[Outcome]]":
    async def call() -> list[Outcome]:
        admission = batcher._admission
        admitted = admission.admit(deadline)
        with admission.in_progress(admitted, sum(each.agents for each in jobs), priority):
            return await batcher.run(jobs, admitted)

    return asyncio.create_task(call())


async def hold(batcher: Batcher, fake: FakeForecaster) -> "asyncio.Task[list[Outcome]]":
    """A call that keeps the model busy."""
    first = submit(batcher, job(fake, 1))
    assert await asyncio.to_thread(fake.entered.wait, 10)
    return first


async def settle() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


async def test_waiting_calls_share_a_batch(batcher: Batcher, fake: FakeForecaster) -> None:
    first = await hold(batcher, fake)
    second, third = submit(batcher, job(fake, 2, x=100.0)), submit(batcher, job(fake, 3, x=200.0))
    await settle()
    assert batcher._admission.waiting == 5
    fake.free.set()
    await first
    [two], [three] = await second, await third
    assert [agents for _, agents, _, _ in fake.batches] == [1, 5]
    assert two.batch_agents == three.batch_agents == 5
    assert two.mixture.origin[:, 0].tolist() == [100.0, 101.0]
    assert three.mixture.origin[:, 0].tolist() == [200.0, 201.0, 202.0]
    assert two.queue > 0
    assert two.inference == three.inference > 0
    assert batcher._admission.waiting == 0


async def test_a_lone_call_does_not_wait(batcher: Batcher, fake: FakeForecaster) -> None:
    fake.free.set()
    [outcome] = await submit(batcher, job(fake, 2))
    assert outcome.batch_agents == 2
    assert outcome.queue < 0.5


async def test_bound_is_kept_and_nobody_overtakes(batcher: Batcher, fake: FakeForecaster) -> None:
    first = await hold(batcher, fake)
    calls = [submit(batcher, job(fake, agents)) for agents in (5, 4, 1, 8)]
    await settle()
    fake.free.set()
    await asyncio.gather(first, *calls)
    assert [agents for _, agents, _, _ in fake.batches] == [1, 5, 5, 8]


async def test_unlike_calls_do_not_share(batcher: Batcher, fake: FakeForecaster) -> None:
    first = await hold(batcher, fake)
    other = FakeForecaster("other")
    calls = [
        submit(batcher, job(fake, 1)),
        submit(batcher, job(fake, 1, kind=PEDESTRIAN)),
        submit(batcher, job(fake, 1, context=Context.BLIND)),
        submit(batcher, job(other, 1)),
        submit(batcher, job(fake, 2)),
    ]
    await settle()
    fake.free.set()
    await asyncio.gather(first, *calls)
    assert fake.batches[1:] == [
        (VEHICLE, 3, Context.FULL, 12),
        (PEDESTRIAN, 1, Context.FULL, 12),
        (VEHICLE, 1, Context.BLIND, 12),
    ]
    assert len(other.batches) == 1


async def test_each_gets_its_own_steps(batcher: Batcher, fake: FakeForecaster) -> None:
    first = await hold(batcher, fake)
    short, long = submit(batcher, job(fake, 1, steps=2)), submit(batcher, job(fake, 1, steps=7))
    await settle()
    fake.free.set()
    await first
    assert (await short)[0].mixture.means.shape[2] == 2
    assert (await long)[0].mixture.covariances.shape[2] == 7
    assert fake.batches[1][3] == 7


async def test_a_large_job_is_split_and_put_together(batcher: Batcher, fake: FakeForecaster) -> None:
    fake.free.set()
    [outcome] = await submit(batcher, job(fake, 19))
    assert [agents for _, agents, _, _ in fake.batches] == [8, 8, 3]
    assert outcome.mixture.origin[:, 0].tolist() == list(range(19))
    assert outcome.batch_agents == 8


async def test_many_small_calls_need_not_wait_for_all_of_a_large_one(fake: FakeForecaster) -> None:
    admission = Admission(8, 200, Metrics())
    batcher = Batcher(8, admission, Metrics())
    batcher.start()
    first = await hold(batcher, fake)
    admission.costs.measure(job(fake, 8).key, 8, 0.02)
    deadline = asyncio.get_running_loop().time() + 1000.0
    large = submit(batcher, job(fake, 64), deadline=deadline)
    small = [submit(batcher, job(fake, 1), deadline=deadline + 0.01) for _ in range(20)]
    await settle()
    fake.free.set()
    await asyncio.gather(first, large, *small)
    # One part of the large call goes first, then all small ones, with which the rest can share no forward
    assert [agents for _, agents, _, _ in fake.batches] == [1, 8, 8, 8, 4, *[8] * 7]
    await batcher.stop()


async def test_a_higher_priority_goes_first(batcher: Batcher, fake: FakeForecaster) -> None:
    first = await hold(batcher, fake)
    order: list[str] = []
    calls = []
    for name, priority in (("low", 0), ("high", 7), ("middle", 3)):
        calls.append(submit(batcher, job(fake, 5), priority=priority))
        calls[-1].add_done_callback(lambda _, name=name: order.append(name))  # type: ignore[misc]
    await settle()
    fake.free.set()
    await asyncio.gather(first, *calls)
    await settle()
    assert order == ["high", "middle", "low"]


async def test_jobs_of_one_call_come_back_in_order(batcher: Batcher, fake: FakeForecaster) -> None:
    fake.free.set()
    outcomes = await submit(batcher, job(fake, 2, x=10.0), job(fake, 1, kind=PEDESTRIAN, x=20.0))
    assert [outcome.mixture.origin[0, 0].item() for outcome in outcomes] == [10.0, 20.0]


async def test_a_full_queue_refuses(batcher: Batcher, fake: FakeForecaster) -> None:
    calls = [await hold(batcher, fake), submit(batcher, job(fake, 19))]
    await settle()
    # The thread of the forward may have been given the next batch already
    calls.append(submit(batcher, job(fake, 20 - batcher._admission.waiting)))
    await settle()
    assert batcher._admission.waiting == 20
    with pytest.raises(Overloaded) as caught:
        await submit(batcher, job(fake, 1))
    assert caught.value.retry_after is not None
    fake.free.set()
    await asyncio.gather(*calls)
    await submit(batcher, job(fake, 20))


async def test_places_are_given_back_without_a_forward(batcher: Batcher) -> None:
    admission = batcher._admission
    call = admission.admit(FAR)
    with admission.in_progress(call, 15):
        assert batcher._admission.waiting == 15
        assert await batcher.run([], call) == []
        assert batcher._admission.waiting == 0
    assert batcher._admission.waiting == 0


async def test_empty_calls_count(batcher: Batcher) -> None:
    admission = batcher._admission
    with admission.in_progress(admission.admit(FAR), 0):
        assert batcher._admission.waiting == 1


async def test_a_late_call_never_runs(batcher: Batcher, fake: FakeForecaster) -> None:
    first = await hold(batcher, fake)
    late = submit(batcher, job(fake, 2), deadline=asyncio.get_running_loop().time() + 0.1)
    await asyncio.sleep(0.15)
    fake.free.set()
    with pytest.raises(DeadlineExceeded):
        await late
    await first
    assert len(fake.batches) == 1
    assert batcher._admission.waiting == 0


async def test_a_cancelled_call_leaves_the_queue(batcher: Batcher, fake: FakeForecaster) -> None:
    first = await hold(batcher, fake)
    gone, stays = submit(batcher, job(fake, 2)), submit(batcher, job(fake, 3))
    await settle()
    gone.cancel()
    await settle()
    assert batcher._admission.waiting == 3
    fake.free.set()
    await asyncio.gather(first, stays)
    assert [agents for _, agents, _, _ in fake.batches] == [1, 3]


async def test_a_call_cancelled_inside_the_model_harms_nobody(batcher: Batcher, fake: FakeForecaster) -> None:
    first = await hold(batcher, fake)
    first.cancel()
    second = submit(batcher, job(fake, 2))
    await settle()
    fake.free.set()
    assert len((await second)[0].mixture) == 2


async def test_a_failure_costs_its_batch_only(batcher: Batcher, fake: FakeForecaster) -> None:
    first = await hold(batcher, fake)
    fake.broken = True
    other = FakeForecaster("other")
    second = submit(batcher, job(other, 1))
    await settle()
    fake.free.set()
    with pytest.raises(Internal):
        await first
    assert await second
    fake.broken = False
    assert await submit(batcher, job(fake, 1))


async def test_a_call_of_two_jobs_fails_as_one(batcher: Batcher, fake: FakeForecaster) -> None:
    fake.free.set()
    fake.broken = True
    with pytest.raises(Internal):
        await submit(batcher, job(fake, 1), job(fake, 1, kind=PEDESTRIAN))
    await settle()
    assert batcher._admission.waiting == 0


async def test_a_forward_of_the_wrong_size_is_a_failure(
    batcher: Batcher, fake: FakeForecaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake.free.set()
    made = fake.forecast
    monkeypatch.setattr(fake, "forecast", lambda *arguments: made(*arguments)[:1])
    with pytest.raises(Internal):
        await submit(batcher, job(fake, 2))


def wrong_modes(mixture: TrajectoryMixture) -> TrajectoryMixture:
    return TrajectoryMixture(
        mixture.log_weights[:, :2], mixture.means[:, :2], mixture.covariances[:, :2], mixture.origin
    )


def wrong_steps(mixture: TrajectoryMixture) -> TrajectoryMixture:
    return TrajectoryMixture(
        mixture.log_weights, mixture.means[:, :, :3], mixture.covariances[:, :, :3], mixture.origin
    )


def wrong_weights(mixture: TrajectoryMixture) -> TrajectoryMixture:
    return replace(mixture, log_weights=mixture.log_weights[:, :2])


def wrong_origins(mixture: TrajectoryMixture) -> TrajectoryMixture:
    return replace(mixture, origin=mixture.origin[:1])


@pytest.mark.parametrize("change", [wrong_modes, wrong_steps, wrong_weights, wrong_origins])
async def test_a_forward_of_other_modes_or_steps_is_a_failure(
    batcher: Batcher,
    fake: FakeForecaster,
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[TrajectoryMixture], TrajectoryMixture],
) -> None:
    fake.free.set()
    made = fake.forecast
    monkeypatch.setattr(fake, "forecast", lambda *arguments: change(made(*arguments)))
    with capture_logs() as logs, pytest.raises(Internal):
        await submit(batcher, job(fake, 2))
    [error] = [entry for entry in logs if entry["event"] == "forward failed"]
    assert error["model"] == "fake"
    monkeypatch.undo()
    assert await submit(batcher, job(fake, 2))


async def test_a_crash_of_the_worker_fails_every_call(
    fake: FakeForecaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    crashed = asyncio.Event()
    batcher = Batcher(8, Admission(8, 20, Metrics()), Metrics())
    batcher.start(crashed.set)
    running = await hold(batcher, fake)
    queued = submit(batcher, job(fake, 1, kind=PEDESTRIAN))
    await settle()
    monkeypatch.setattr(batcher, "_deliver", Mock(side_effect=RuntimeError("a bug")))
    fake.free.set()
    async with asyncio.timeout(10):
        await crashed.wait()
        for call in (running, queued, submit(batcher, job(fake, 1))):
            with pytest.raises(Internal):
                await call
    assert (batcher._admission.waiting, batcher.forward_seconds) == (0, 0.0)
    await batcher.stop()


async def test_a_crash_beside_another_forward_is_told_once(
    fake: FakeForecaster, monkeypatch: pytest.MonkeyPatch
) -> None:
    crash = Mock()
    batcher = Batcher(8, Admission(8, 20, Metrics()), Metrics(), ForwardThreads(2, 2, 1, 0))
    batcher._costs.measure(None, 8, 1e-6)
    batcher.start(crash)
    other = FakeForecaster()
    other.free.clear()
    calls = [submit(batcher, job(fake, 8)), submit(batcher, job(other, 8))]
    await asyncio.gather(entered_again(fake), entered_again(other))
    deliver = batcher._deliver
    first = [RuntimeError("a bug")]

    def fail_once(*arguments):  # type: ignore[no-untyped-def]
        if first:
            raise first.pop()
        deliver(*arguments)

    monkeypatch.setattr(batcher, "_deliver", fail_once)
    tasks = [batch.task for batch in batcher._batches if batch.task]
    for forecaster in (fake, other):
        forecaster.free.set()
    # The other forward may end in the same turn of the event loop, before the crash is known
    results = await asyncio.gather(*calls, return_exceptions=True)
    assert any(isinstance(result, Internal) for result in results)
    assert all(isinstance(result, Internal | list) for result in results)
    await asyncio.wait(tasks)
    await settle()
    crash.assert_called_once_with()
    await batcher.stop()


async def test_a_stop_is_no_crash(fake: FakeForecaster) -> None:
    crashed = asyncio.Event()
    batcher = Batcher(8, Admission(8, 20, Metrics()), Metrics())
    batcher.start(crashed.set)
    await settle()
    await batcher.stop()
    await settle()
    assert not crashed.is_set()


async def test_the_age_of_a_forward_is_known(batcher: Batcher, fake: FakeForecaster) -> None:
    assert batcher.forward_seconds == 0
    first = await hold(batcher, fake)
    await asyncio.sleep(0.05)
    assert batcher.forward_seconds >= 0.05
    fake.free.set()
    await first
    await settle()
    assert batcher.forward_seconds == 0


async def test_stop_fails_what_waits_and_finishes_what_runs(fake: FakeForecaster) -> None:
    batcher = Batcher(8, Admission(8, 20, Metrics()), Metrics())
    batcher.start()
    first = await hold(batcher, fake)
    second = submit(batcher, job(fake, 1))
    await settle()
    stopping = asyncio.create_task(batcher.stop())
    await settle()
    fake.free.set()
    await stopping
    for call in (first, second):
        with pytest.raises(Unavailable):
            await call


async def test_a_second_forward_needs_no_place(batcher: Batcher, fake: FakeForecaster) -> None:
    fake.free.set()
    assert await batcher.run([job(fake, 3)], Call(FAR))
    assert batcher._admission.waiting == 0


async def test_warm_up_goes_past_the_queue(batcher: Batcher, fake: FakeForecaster) -> None:
    fake.free.set()
    await batcher.run_in_model_threads(job(fake, 30))
    assert fake.batches == [(VEHICLE, 30, Context.FULL, 12)]


async def test_threads_of_the_forward() -> None:
    seen = []

    class Counting(FakeForecaster):
        def forecast(self, *arguments, **named):  # type: ignore[no-untyped-def]
            seen.append((torch.get_num_threads(), torch.is_inference_mode_enabled()))
            return super().forecast(*arguments, **named)

    before = torch.get_num_threads()
    batcher = Batcher(8, Admission(8, 20, Metrics()), Metrics(), ForwardThreads(3, 1, 3, 0))
    batcher.start()
    try:
        await submit(batcher, job(Counting(), 1))
    finally:
        await batcher.stop()
        torch.set_num_threads(before)  # what a thread sets is the default of those that start later
    assert seen == [(3, True)]


async def entered_again(fake: FakeForecaster) -> None:
    """Wait until another forward has begun."""
    assert await asyncio.to_thread(fake.entered.wait, 10)
    fake.entered.clear()


async def begun(fake: FakeForecaster, forwards: int) -> None:
    """Wait until so many forwards have begun."""
    for _ in range(10_000):
        if len(fake.batches) >= forwards:
            return
        await asyncio.sleep(0.001)
    pytest.fail(f"{len(fake.batches)} of {forwards} forwards have begun")


@pytest.fixture
async def pair(admission: Admission) -> AsyncIterator[Batcher]:
    """A batcher with two forwards at a time, and forwards that are too short to spread a call over both."""
    made = Batcher(8, admission, Metrics(), ForwardThreads(2, 2, 1, 0))
    made._costs.measure(None, 8, 1e-6)
    made.start()
    yield made
    await made.stop()


async def test_two_forwards_run_at_the_same_time(pair: Batcher, fake: FakeForecaster) -> None:
    calls = []
    for x in (10.0, 20.0):
        calls.append(submit(pair, job(fake, 8, x=x)))
        await entered_again(fake)
    assert len(fake.batches) == 2
    third = submit(pair, job(fake, 2, x=30.0))
    await settle()
    assert len(fake.batches) == 2
    fake.free.set()
    origins = [(await call)[0].mixture.origin[:2, 0].tolist() for call in (*calls, third)]
    assert origins == [[10, 11], [20, 21], [30, 31]]


async def test_the_free_forwards_share_a_call_that_is_alone(pair: Batcher, fake: FakeForecaster) -> None:
    pair._costs.measure(job(fake, 1).key, 7, 0.1)
    call = submit(pair, job(fake, 7, x=10.0))
    await begun(fake, 2)
    fake.free.set()
    [outcome] = await call
    assert sorted(agents for _, agents, _, _ in fake.batches) == [3, 4]
    assert outcome.mixture.origin[:, 0].tolist() == [10, 11, 12, 13, 14, 15, 16]
    assert outcome.batch_agents == 4


async def test_a_call_whose_parts_would_be_late_is_not_spread(pair: Batcher, fake: FakeForecaster) -> None:
    fake.free.set()
    pair._costs.measure(job(fake, 1).key, 8, 100.0)  # a wrong estimate
    admitted = Call(asyncio.get_running_loop().time() + 10.0)
    [outcome] = await pair.run([job(fake, 8)], admitted)
    assert outcome.batch_agents == 8
    assert len(fake.batches) == 1


async def test_a_call_fails_with_the_first_part_that_fails(pair: Batcher, fake: FakeForecaster) -> None:
    pair._costs.measure(job(fake, 1).key, 8, 0.1)
    call = submit(pair, job(fake, 8))
    await begun(fake, 2)
    with capture_logs():
        pair._fail(pair._batches[1].entries, Internal())
        with pytest.raises(Internal):
            await call  # although the first part is still in the model
    fake.free.set()


async def test_a_busy_server_does_not_spread_calls(pair: Batcher, fake: FakeForecaster) -> None:
    pair._costs.measure(job(fake, 1).key, 7, 0.1)
    first = submit(pair, job(fake, 8))
    await begun(fake, 2)
    calls = [submit(pair, job(fake, 4)) for _ in range(2)]
    await settle()
    fake.batches.clear()
    fake.free.set()
    await asyncio.gather(first, *calls)
    assert all(agents in (4, 8) for _, agents, _, _ in fake.batches)


async def test_calls_that_wait_for_several_free_forwards_are_spread_over_them(
    pair: Batcher, fake: FakeForecaster
) -> None:
    pair._costs.measure(job(fake, 1).key, 3, 1e-6)
    pair._costs.measure(job(fake, 1).key, 6, 0.1)
    calls = [submit(pair, job(fake, 3, x=10.0 * number)) for number in range(2)]
    await begun(fake, 2)
    fake.free.set()
    await asyncio.gather(*calls)
    assert [agents for _, agents, _, _ in fake.batches] == [3, 3]


@pytest.mark.parametrize(
    ("intervals", "seconds"),
    [
        ([], 0.0),
        ([(1.0, 2.0)], 2.0),
        ([(1.0, 2.0), (1.5, 1.0)], 2.0),
        ([(4.0, 1.0), (1.0, 2.0), (2.0, 2.0)], 4.0),
        ([(5.0, 1.0), (1.0, 2.0)], 3.0),
    ],
)
def test_time_in_the_model_counts_once(intervals: list[tuple[float, float]], seconds: float) -> None:
    mixture = Mock()
    outcomes = [Outcome(mixture, start, duration, 1) for start, duration in intervals]
    assert seconds_in_model(outcomes) == pytest.approx(seconds)


async def test_admission_knows_when_a_forward_ends_only_if_all_are_taken(
    pair: Batcher, admission: Admission, fake: FakeForecaster
) -> None:
    first = submit(pair, job(fake, 8))
    await entered_again(fake)
    assert admission.busy_until is None
    second = submit(pair, job(fake, 8))
    await entered_again(fake)
    assert admission.busy_until is not None
    assert not pair.is_free
    fake.free.set()
    await asyncio.gather(first, second)
    await settle()
    assert admission.busy_until is None
    assert pair.is_free


async def test_a_failed_forward_leaves_the_other_one_alone(pair: Batcher, fake: FakeForecaster) -> None:
    broken = FakeForecaster()
    broken.free.clear()
    broken.broken = True
    good, bad = submit(pair, job(fake, 8)), submit(pair, job(broken, 8))
    await asyncio.gather(entered_again(fake), entered_again(broken))
    broken.free.set()
    with pytest.raises(Internal):
        await bad
    fake.free.set()
    assert await good


@pytest.mark.parametrize(("seconds", "forwards"), [(1e-6, 1), (100.0, 2)])
async def test_few_agents_wait_for_a_forward_that_ends_before_theirs_would(
    pair: Batcher, fake: FakeForecaster, seconds: float, forwards: int
) -> None:
    pair._costs.measure(job(fake, 1).key, 1, seconds)
    pair._costs.measure(job(fake, 1, PEDESTRIAN).key, 1, 1e-2)
    first = submit(pair, job(fake, 1))
    await entered_again(fake)
    small = submit(pair, job(fake, 1, PEDESTRIAN))
    if forwards == 2:
        await entered_again(fake)
    await settle()
    assert len(fake.batches) == forwards
    fake.free.set()
    await asyncio.gather(first, small)


@pytest.mark.parametrize("forwards", [1, 2])
async def test_the_event_loop_rests_while_few_agents_wait(
    fake: FakeForecaster, monkeypatch: pytest.MonkeyPatch, forwards: int
) -> None:
    batcher = Batcher(32, Admission(32, 64, Metrics()), Metrics(), ForwardThreads(forwards, forwards, 1, 0))
    batcher.start()
    first = await hold(batcher, fake)
    second = submit(batcher, job(fake, 1))
    await settle()
    look = Mock(side_effect=batcher._free_slots)
    monkeypatch.setattr(batcher, "_free_slots", look)
    await asyncio.sleep(0.05)  # longer than the forward was expected to take
    assert look.call_count <= 2
    fake.free.set()
    assert await first
    assert await second
    await batcher.stop()


async def test_warm_up_runs_once_for_all_threads(pair: Batcher, fake: FakeForecaster) -> None:
    fake.free.set()
    await pair.run_in_model_threads(job(fake, 3))
    assert [agents for _, agents, _, _ in fake.batches] == [3]
