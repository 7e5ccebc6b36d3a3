"""Forecasts of one model for one agent, and which of their sets are complete, exact and settled."""

import numpy as np
import pytest

from service.tracking.store.base import AGE_TOLERANCE, MAX_FORECASTS
from service.tracking.store.forecast_history import ForecastHistory
from service.tracking.store.records import AGES, BLOCK
from tests.service.tracking.store.track_updates import START, forecast, times


def path(steps: int = AGES, y: float = 0.0) -> bytes:
    """Return a forecast whose x at each step is the number of the step, m."""
    return forecast(np.stack([np.arange(steps + 1.0), np.full(steps + 1, y)], axis=1))


def filled(offset: float = 0.0, steps: int = AGES) -> ForecastHistory:
    """Return forecasts at the twelve lags of the thirteenth time, each made some seconds later."""
    history = ForecastHistory()
    for time in times(AGES):
        assert history.insert(time + offset, path(steps), steps)
    return history


INSTANT = times(AGES + 1)[-1]


def test_a_complete_set_has_the_step_of_each_age() -> None:
    found = filled().collect(INSTANT)
    assert found.complete
    assert found.exact
    assert found.made_at == list(times(AGES))[::-1]
    for age, block in enumerate(found.blocks, start=1):
        steps = np.frombuffer(block, dtype=BLOCK)["point"][:, 0]
        np.testing.assert_array_equal(steps, [age - 1, age, age + 1 if age < AGES else np.nan])


@pytest.mark.parametrize("missing", [0, 5, 11])
def test_without_one_age_a_set_is_incomplete(missing: int) -> None:
    history = ForecastHistory()
    for number, time in enumerate(times(AGES)):
        if number != missing:
            history.insert(time, path(), AGES)
    found = history.collect(INSTANT)
    assert not found.complete
    absent = AGES - 1 - missing
    assert np.isnan(found.made_at).tolist() == [age == absent for age in range(AGES)]
    assert np.isnan(np.frombuffer(found.blocks[absent], dtype=BLOCK)["point"]).all()


def test_a_short_horizon_reaches_only_the_young_ages() -> None:
    found = filled(steps=4).collect(INSTANT)
    assert not found.complete
    assert np.isnan(found.made_at).tolist() == [False] * 4 + [True] * 8


@pytest.mark.parametrize(("offset", "complete"), [(0.05, True), (-0.05, True), (0.2, False), (-0.2, False)])
def test_forecasts_near_their_lags_are_not_exact(offset: float, complete: bool) -> None:
    found = filled(offset).collect(INSTANT)
    assert found.complete is complete
    assert found.exact is not complete  # without a single forecast, none is off its lag


def test_the_nearest_forecast_wins_and_of_two_the_older() -> None:
    history = ForecastHistory()
    lag = INSTANT - 0.5
    for time in (lag - 0.08, lag - 0.0625, lag + 0.0625, lag + 0.08):
        history.insert(time, path(), AGES)
    assert history.collect(INSTANT).made_at[0] == lag - 0.0625
    history.insert(lag + 0.03125, path(), AGES)
    assert history.collect(INSTANT).made_at[0] == lag + 0.03125


def test_the_first_forecast_of_a_time_is_kept() -> None:
    history = ForecastHistory()
    assert history.insert(START, path(y=1.0), AGES)
    assert not history.insert(START, path(y=2.0), AGES)
    assert not history.insert(START + 1e-5, path(y=3.0), AGES)
    assert len(history) == 1
    (block, *_) = history.collect(START + 0.5).blocks
    assert np.frombuffer(block, dtype=BLOCK)["point"][1].tolist() == [1.0, 1.0]


def test_times_ascend_whatever_the_order_of_arrival() -> None:
    history = ForecastHistory()
    for time in (START + 1.0, START, START + 2.0, START + 0.5):
        history.insert(time, path(), AGES)
    assert history.times == [START, START + 0.5, START + 1.0, START + 2.0]


def test_a_set_waits_and_then_settles() -> None:
    history = filled()
    for _ in range(2):
        history.mark_pending(INSTANT)
    assert history.pending == [INSTANT]
    assert not history.is_settled(INSTANT)
    history.mark_settled(INSTANT)
    assert history.pending == []
    assert history.is_settled(INSTANT)
    assert not history.is_settled(INSTANT - 0.5)
    assert not history.is_settled(INSTANT + 0.5)


def test_trimming_drops_what_is_old() -> None:
    history = filled()
    history.mark_pending(START + 0.5)
    history.mark_settled(START + 1.0)
    history.mark_settled(INSTANT)
    history.trim(START + 2.0)
    assert history.times == list(times(AGES))[4:]
    assert sorted(history._forecasts) == history.times
    assert history.pending == []
    assert not history.is_settled(START + 1.0)
    assert history.is_settled(INSTANT)


def test_the_oldest_forecasts_go_when_there_are_too_many() -> None:
    history = ForecastHistory()
    made = [START + 0.01 * number for number in range(MAX_FORECASTS + 3)]
    for time in made:
        history.insert(time, path(), AGES)
    history.trim(START - 1.0)
    assert history.times == made[3:]
    assert sorted(history._forecasts) == history.times


def test_the_cheap_check_refuses_no_complete_set() -> None:
    assert filled().may_be_complete(INSTANT)
    assert filled(0.9 * AGE_TOLERANCE).may_be_complete(INSTANT)
    assert not filled().may_be_complete(INSTANT - 0.5)
    assert not ForecastHistory().may_be_complete(INSTANT)
