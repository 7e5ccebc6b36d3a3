"""Order and size of batches, and costs of forwards."""

from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.predict.scheduler import (
    MAX_BATCH_SECONDS,
    MIN_BATCH_AGENTS,
    CostModel,
    DeadlineQueue,
    Departure,
)


@dataclass(eq=False)
class Entry:
    deadline: float
    agents: int = 1
    key: str = "model"
    finished: bool = False
    priority: int = 0


def costs(rate: float = 1000.0, key: str = "model") -> CostModel:
    model = CostModel()
    model.measure(key, int(rate), 1.0)
    return model


def queue(*entries: Entry, rate: float = 1000.0) -> DeadlineQueue[Entry]:
    made: DeadlineQueue[Entry] = DeadlineQueue(costs(rate))
    for entry in entries:
        made.put(entry)
    return made


def test_the_earliest_deadline_goes_first_and_equal_ones_in_order_of_arrival() -> None:
    late, first, second = Entry(9.0), Entry(5.0), Entry(5.0)
    batch, dropped, _ = queue(late, first, second).take_batch(0.0, 2)
    assert batch == [first, second]
    assert not dropped


def test_a_batch_holds_one_key_and_the_rest_waits() -> None:
    one, other, third = Entry(1.0), Entry(2.0, key="other"), Entry(3.0)
    waiting = queue(one, other, third)
    assert waiting.take_batch(0.0, 8)[0] == [one, third]
    assert waiting.take_batch(0.0, 8)[0] == [other]
    assert len(waiting) == 0


def test_nothing_overtakes_an_entry_of_its_key_that_does_not_fit() -> None:
    one, large, small = Entry(1.0, 5), Entry(2.0, 5), Entry(3.0, 1)
    waiting = queue(one, large, small)
    assert waiting.take_batch(0.0, 8)[0] == [one]
    assert waiting.take_batch(0.0, 8)[0] == [large, small]


def test_entries_that_would_be_late_are_dropped_before_they_take_the_models_time() -> None:
    hopeless, possible, cancelled = Entry(10.05, 100), Entry(10.2, 100), Entry(10.01, finished=True)
    batch, dropped, _ = queue(hopeless, possible, cancelled).take_batch(10.0, 256)
    assert batch == [possible]
    assert dropped == [hopeless]


def test_a_batch_ends_where_it_would_take_too_long() -> None:
    rate = 2 * MIN_BATCH_AGENTS / MAX_BATCH_SECONDS
    entries = [Entry(100.0, MIN_BATCH_AGENTS) for _ in range(4)]
    assert len(queue(*entries, rate=rate).take_batch(0.0, 1000)[0]) == 2
    slow = [Entry(1e9, MIN_BATCH_AGENTS // 2) for _ in range(4)]
    assert len(queue(*slow, rate=1.0).take_batch(0.0, 1000)[0]) == 2  # never less than MIN_BATCH_AGENTS


def test_parts_of_a_large_call_lag_so_that_small_calls_get_between() -> None:
    waiting = queue()
    parts = [Entry(10.0, 50) for _ in range(3)]
    for number, part in enumerate(parts):
        waiting.put(part, lag=0.05 * number)
    small = Entry(10.02)
    waiting.put(small)
    assert list(waiting) == [parts[0], small, parts[1], parts[2]]


def test_a_higher_priority_goes_first() -> None:
    late, urgent, important = Entry(9.0), Entry(1.0), Entry(9.0, priority=1)
    assert list(queue(late, urgent, important)) == [important, urgent, late]


def test_removed_entries_leave() -> None:
    entry, other = Entry(1.0), Entry(1.0)
    waiting = queue(entry, other)
    waiting.remove(entry)
    waiting.remove(entry)
    assert list(waiting) == [other]
    waiting.clear()
    assert len(waiting) == 0


def test_batches_say_why_they_left() -> None:
    few = [Entry(100.0, 2) for _ in range(3)]
    assert queue(*few).take_batch(0.0, 8)[2] is Departure.EMPTY
    assert queue(*few, Entry(100.0, key="other")).take_batch(0.0, 8)[2] is Departure.EMPTY
    assert queue(*few).take_batch(0.0, 4)[2] is Departure.AGENTS
    many = [Entry(100.0, MIN_BATCH_AGENTS) for _ in range(3)]
    assert queue(*many).take_batch(0.0, 1000)[2] is Departure.TIME
    assert queue(Entry(0.025, 20), Entry(9.0, 20)).take_batch(0.0, 1000)[2] is Departure.DEADLINE


def test_a_batch_takes_nothing_that_would_make_its_first_entry_late() -> None:
    urgent, others = Entry(10.035, 10), [Entry(20.0, 10) for _ in range(5)]
    waiting = queue(urgent, *others)
    assert waiting.take_batch(10.0, 1000)[0] == [urgent, *others[:2]]


def test_time_after_the_forward_counts_for_the_deadline() -> None:
    model = costs()
    for _ in range(50):
        model.measure_around(1, 0.0, after=0.1)
    waiting: DeadlineQueue[Entry] = DeadlineQueue(model)
    hopeless, possible = Entry(10.1, 10), Entry(10.12, 10)
    for entry in (hopeless, possible):
        waiting.put(entry)
    assert waiting.take_batch(10.0, 256)[:2] == ([possible], [hopeless])


def test_costs_are_learned_by_key() -> None:
    model = costs(1000.0)
    model.measure("slow", 10, 1.0)
    assert model.seconds("model", 100) == pytest.approx(0.1)
    assert model.seconds("slow", 100) == pytest.approx(10.0)
    assert model.seconds("new", 100) == model.seconds_of_unknown(100) == pytest.approx(10.0)
    for _ in range(50):
        model.measure("slow", 1000, 1.0)
    assert model.seconds("slow", 100) == pytest.approx(0.1, rel=0.01)


@given(
    st.lists(
        st.tuples(st.floats(0, 100), st.integers(1, 40), st.sampled_from("ab"), st.booleans()), max_size=30
    ),
    st.integers(1, 64),
)
def test_every_entry_leaves_once_in_a_batch_or_as_late(
    made: list[tuple[float, int, str, bool]], max_agents: int
) -> None:
    entries = [Entry(deadline, agents, key, finished) for deadline, agents, key, finished in made]
    waiting = queue(*entries, rate=200.0)
    left: list[Entry] = []
    for _ in range(len(entries) + 1):
        batch, late, _ = waiting.take_batch(50.0, max_agents)
        assert len({entry.key for entry in batch}) <= 1
        assert sum(entry.agents for entry in batch) <= max_agents or len(batch) == 1
        assert all(entry.deadline < 50.0 + entry.agents / 200.0 + 1.0 for entry in late)
        left += [*batch, *late]
        if not batch:
            break
    assert len(waiting) == 0
    assert sorted(map(id, left)) == sorted(id(entry) for entry in entries if not entry.finished)


def test_work_around_a_call_is_known_by_size() -> None:
    model = costs()
    assert model.around(8) == 0
    model.measure_around(1, 0.01, 0.0)
    assert model.around(500) == pytest.approx(0.01)  # a guess refuses nobody
    model.measure_around(512, 0.512, 0.0)
    assert model.around(512) == pytest.approx(0.512)
    assert model.around(256) == pytest.approx(0.256)
    assert model.work(512) == pytest.approx(0.512 + 0.512)


def test_each_size_has_its_own_rate_and_others_that_of_the_nearest() -> None:
    model = CostModel()
    model.measure("model", 1, 0.005)
    model.measure("model", 32, 0.010)
    assert model.seconds("model", 1) == pytest.approx(0.005)
    assert model.seconds("model", 32) == pytest.approx(0.01)
    assert model.seconds("model", 40) == pytest.approx(0.0125)
    assert model.seconds("model", 320) == pytest.approx(0.1)
    assert model.batch_agents("model", 1000) == 160
    assert model.batch_agents("new", 1000) == 160


def test_a_size_that_does_not_occur_becomes_slower_and_faster_as_the_others_do() -> None:
    model = CostModel()
    model.measure("model", 8, 8 / 1000)
    model.measure("model", 128, 128 / 2000)
    assert model.batch_agents("model", 1000) == 100
    for _ in range(30):  # a busy machine: half as fast as at warm-up
        model.measure("model", 8, 8 / 500)
    assert model.seconds("model", 8) == pytest.approx(8 / 500, rel=0.01)
    assert model.seconds("model", 128) == pytest.approx(128 / 1000, rel=0.01)
    assert model.batch_agents("model", 1000) == pytest.approx(50, abs=1)
    model.measure("model", 128, 128 / 1500)
    assert model.seconds("model", 128) == pytest.approx(128 / 1100, rel=0.01)  # smoothed
    for _ in range(60):
        model.measure("model", 8, 8 / 1000)
    assert model.seconds("model", 128) == pytest.approx(128 / 2000, rel=0.1)
    assert model.seconds("model", 8) == pytest.approx(8 / 1000, rel=0.01)


def test_a_size_that_does_not_occur_does_not_become_faster_than_it_was() -> None:
    model = CostModel()
    model.measure("model", 1, 0.003)  # cold
    model.measure("model", 128, 128 / 2000)
    for _ in range(60):
        model.measure("model", 1, 0.001)
    assert model.seconds("model", 128) == pytest.approx(128 / 2000, rel=0.1)


def test_one_stall_makes_no_size_slow_for_long() -> None:
    model = CostModel()
    for size in (8, 128):
        model.measure("model", size, size / 1000)
    for _ in range(30):
        model.measure("model", 8, 8 / 1000)
    model.measure("model", 8, 0.5)
    assert model.seconds("model", 128) < 1.3 * 128 / 1000


def test_forwards_share_a_call_that_is_alone() -> None:
    model = CostModel()
    model.measure("model", 128, 0.1)
    assert model.alone(128) == pytest.approx(0.1)
    model.forwards = 4
    model.measure("model", 32, 0.028)
    assert model.alone(128) == pytest.approx(0.028)
    assert model.work(128) == pytest.approx(0.1)
    assert [model.share("model", 32, free) for free in (0, 1, 2, 4, 8)] == [32, 32, 16, 8, 8]
    assert model.share("model", 4, 4) == 4  # 3.5 ms of work


def test_what_other_forwards_share_is_no_limit() -> None:
    several = [Entry(9.0, 4) for _ in range(4)]
    batch, _, departure = queue(*several).take_batch(0.0, 1000, share=8)
    assert (len(batch), departure) == (2, Departure.SHARE)


def test_a_size_that_is_new_under_load_has_the_rate_that_was_measured() -> None:
    model = CostModel()
    for rate in (1000, *[500] * 50):
        model.measure("model", 8, 8 / rate)
    model.measure("model", 128, 128 / 900)
    assert model.seconds("model", 128) == pytest.approx(128 / 900)
    for _ in range(50):
        model.measure("model", 8, 8 / 500)
    assert model.seconds("model", 128) == pytest.approx(128 / 900, rel=0.01)


def test_a_wrong_estimate_cannot_refuse_for_ever() -> None:
    only = Entry(10.05, 100)
    waiting = queue(only, rate=1.0)
    assert waiting.take_batch(10.0, 256)[:2] == ([only], [])
    past, possible = Entry(9.0, 100), Entry(10.05, 100)
    assert queue(past, possible, rate=1.0).take_batch(10.0, 256)[:2] == ([possible], [past])
