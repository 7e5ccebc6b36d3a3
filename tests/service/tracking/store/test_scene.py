"""State machine of a scene: which sets settle and when, and what is dropped."""

import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.tracking.store.base import (
    MAX_FORECASTS,
    MAX_MODELS,
    SETTLE_AFTER,
    WINDOW,
    TrackStatus,
    TrackUpdate,
)
from service.tracking.store.log_entry import LogEntry
from service.tracking.store.records import AGES, COMPLETE, NEWLY, SETTLED, unpack_instants
from service.tracking.store.scene import ApplyResult, SceneMemory
from service.tracking.store.track import join_instants
from tests.service.tracking.store.track_updates import MODEL, START, observation, times, track_update, where


def replay(scene: SceneMemory, moments: list[float], **options: object) -> list[ApplyResult]:
    return [scene.apply(LogEntry(t, [track_update(t, **options)])) for t in moments]  # type: ignore[arg-type]


def settled(outcomes: list[ApplyResult]) -> dict[tuple[str, str, float], np.void]:
    """Return the settled instants by agent, model and time; fail if one settles twice."""
    found: dict[tuple[str, str, float], np.void] = {}
    for outcome in outcomes:
        told = join_instants(outcome.instants)
        for row, agent_id, model in zip(
            unpack_instants(told.packed), told.agent_ids, told.models, strict=True
        ):
            if row["flags"] & NEWLY:
                key = agent_id, model, float(row["time"])
                assert key not in found
                assert row["flags"] == COMPLETE | SETTLED | NEWLY
                found[key] = row
    return found


def test_a_set_is_complete_from_the_thirteenth_frame_on() -> None:
    moments = list(times(16))
    found = settled(replay(SceneMemory(), moments, miss=0.25))
    assert sorted(time for _, _, time in found) == moments[12:]
    row = found["a", MODEL, moments[12]]
    assert row["made_at"].tolist() == moments[11::-1]
    assert row["position"].tolist() == list(where(moments[12]))
    at = row["blocks"]["point"][:, 1]
    assert at.tolist() == [[where(moments[12])[0], 0.25]] * AGES


def test_at_ten_hertz_the_lags_are_met_exactly() -> None:
    moments = list(times(80, 0.1))
    found = settled(replay(SceneMemory(), moments))
    assert len(found) == 80 - 60
    for (_, _, time), row in found.items():
        assert np.allclose(time - row["made_at"], 0.5 * np.arange(1, AGES + 1), rtol=0, atol=1e-5)


@pytest.mark.parametrize("step", [0.5, 0.1])
@pytest.mark.parametrize("late", [1.0, 1.9])
def test_the_order_of_arrival_makes_no_difference(step: float, late: float) -> None:
    moments = list(times(round(20 / step), step))
    in_order = settled(replay(SceneMemory(), moments))
    rng = random.Random(1)
    shuffled = sorted(moments, key=lambda t: t + rng.uniform(0, late))
    assert shuffled != moments
    found = settled(replay(SceneMemory(), shuffled))
    assert found.keys() == in_order.keys()
    assert all(found[key].tobytes() == in_order[key].tobytes() for key in found)


def test_a_call_that_comes_twice_counts_once() -> None:
    moments = [t for t in times(20) for _ in range(2)]
    once = settled(replay(SceneMemory(), list(times(20))))
    assert settled(replay(SceneMemory(), moments)).keys() == once.keys()


def test_a_second_answer_tells_what_was_settled_but_not_anew() -> None:
    scene = SceneMemory()
    replay(scene, list(times(13)))
    (outcome,) = replay(scene, [times(13)[-1]])
    (instant,) = unpack_instants(join_instants(outcome.instants).packed)
    assert instant["flags"] == COMPLETE | SETTLED


def test_of_one_time_what_came_first_is_kept() -> None:
    scene = SceneMemory()
    moments = list(times(13))
    for moment in moments[:12]:
        replay(scene, [moment], miss=1.0)
        replay(scene, [moment], miss=7.0)
    found = settled(replay(scene, moments[12:]))
    assert found["a", MODEL, moments[12]]["blocks"]["point"][:, 1, 1].tolist() == [1.0] * AGES


def test_a_missing_frame_leaves_sets_incomplete() -> None:
    moments = list(times(40))
    lost = moments.pop(15)
    found = settled(replay(SceneMemory(), moments))
    without = {lost + 0.5 * age for age in range(AGES + 1)}
    assert {time for _, _, time in found} == set(moments[12:]) - without


def test_forecasts_off_their_lags_settle_two_seconds_later() -> None:
    rng = random.Random(1)
    moments = [t + rng.uniform(-0.04, 0.04) for t in times(30)]
    scene = SceneMemory()
    for number, moment in enumerate(moments):
        (outcome,) = replay(scene, [moment])
        found = settled([outcome])
        due = [t for t in moments[12:number] if moment - t >= SETTLE_AFTER > moments[number - 1] - t]
        assert [time for _, _, time in found] == due
        newest = unpack_instants(join_instants(outcome.instants).packed)[0]
        assert newest["flags"] == (COMPLETE if number >= 12 else 0)


async def test_the_nearest_forecast_is_taken_and_none_beyond_the_tolerance() -> None:
    scene = SceneMemory()
    moments = list(times(13))
    for moment in moments[:12]:
        replay(scene, [moment - 0.08, moment + 0.04])
    replay(scene, [moments[12], moments[12] + SETTLE_AFTER])
    _, instants = await scene.snapshot(99.0)
    rows = unpack_instants(join_instants(instants).packed)
    (row,) = rows[rows["time"] == moments[12]]
    assert np.allclose(row["made_at"], np.array(moments[11::-1]) + 0.04, rtol=0, atol=1e-6)

    other = SceneMemory()
    replay(other, [moment + 0.12 for moment in moments[:12]])
    (outcome,) = replay(other, [moments[12]])
    (row,) = unpack_instants(join_instants(outcome.instants).packed)
    assert row["flags"] == 0
    assert np.isnan(row["made_at"]).all()


def test_a_shorter_horizon_never_completes_a_set() -> None:
    scene = SceneMemory()
    outcomes = replay(scene, list(times(20)), steps=6)
    assert not settled(outcomes)
    row = unpack_instants(join_instants(outcomes[-1].instants).packed)[0]
    assert np.isfinite(row["made_at"]).tolist() == [True] * 6 + [False] * 6
    assert np.isnan(row["blocks"]["point"][5, 2]).all()


def test_every_model_has_a_forecast_history_of_its_own() -> None:
    scene = SceneMemory()
    outcomes: list[ApplyResult] = []
    for moment in times(14):
        for model in ("cab@1.0.0", "kalman@1.0.0"):
            outcomes += replay(scene, [moment], model=model)
    found = settled(outcomes)
    assert {(model, time) for _, model, time in found} == {
        (model, time) for model in ("cab@1.0.0", "kalman@1.0.0") for time in times(14)[12:]
    }


def test_an_observation_is_the_truth_for_every_model() -> None:
    """This happens when an agent falls back to another model for one frame."""
    scene = SceneMemory()
    moments = list(times(13))
    replay(scene, moments[:12])
    found = settled(replay(scene, moments[12:], model="constant-velocity-yaw@1.0.0"))
    assert list(found) == [("a", MODEL, moments[12])]


def test_agents_are_told_apart() -> None:
    scene = SceneMemory()
    outcomes = [
        scene.apply(LogEntry(t, [track_update(t, "a", miss=1.0), track_update(t, "b", off=50.0, miss=2.0)]))
        for t in times(13)
    ]
    found = settled(outcomes)
    time = times(13)[-1]
    assert found["a", MODEL, time]["blocks"]["point"][0, 1].tolist() == [where(time)[0], 1.0]
    assert found["b", MODEL, time]["blocks"]["point"][0, 1].tolist() == [where(time)[0], 52.0]


def test_a_type_that_wavers_keeps_its_track() -> None:
    scene = SceneMemory()
    first = replay(scene, list(times(12)))
    assert [outcome.track_statuses for outcome in first] == [[TrackStatus.NEW]] + [[TrackStatus.KEPT]] * 11
    (outcome,) = replay(scene, [times(13)[-1]], agent_type=b"c")
    assert outcome.track_statuses == [TrackStatus.RETYPED]
    assert settled([outcome])
    late, again, back = (
        replay(scene, [moment], agent_type=kind)[0].track_statuses[0]
        for moment, kind in ((times(13)[-1] - 0.25, b"v"), (times(14)[-1], b"c"), (times(15)[-1], b"v"))
    )
    assert (late, again, back) == (TrackStatus.RETYPED, TrackStatus.KEPT, TrackStatus.RETYPED)


@pytest.mark.parametrize("step", [0.1, 0.5])
@pytest.mark.parametrize("jump", [0.06, 0.33])
def test_a_call_that_is_behind_says_by_how_much(step: float, jump: float) -> None:
    scene = SceneMemory()
    moments = list(times(10, step))
    assert [outcome.behind_s for outcome in replay(scene, moments)] == [0.0] * 10
    assert [outcome.behind_s for outcome in replay(scene, moments[-3:])] == [0.0] * 3  # repeated
    back = [moments[-1] - jump + step * number for number in range(8)]
    expected = [max(jump - step * number, 0.0) for number in range(8)]
    assert [outcome.behind_s for outcome in replay(scene, back)] == pytest.approx(expected, abs=1e-6)


def test_a_repeated_time_with_another_content_is_behind() -> None:
    scene = SceneMemory()
    moments = list(times(10))
    replay(scene, moments)
    (outcome,) = replay(scene, moments[-3:-2], off=5.0)
    assert outcome.behind_s == pytest.approx(1.0)
    (outcome,) = replay(scene, moments[-8:-7])
    assert outcome.track_statuses == [TrackStatus.RESET]
    assert outcome.behind_s == pytest.approx(3.5)


@pytest.mark.parametrize("off", [60.0, 1e6])
def test_an_id_that_another_agent_has_begins_anew(off: float) -> None:
    scene = SceneMemory()
    replay(scene, list(times(12)))
    (outcome,) = replay(scene, [times(13)[-1]], off=off)
    assert outcome.track_statuses == [TrackStatus.RESET]
    assert not settled([outcome])


def test_a_contradiction_at_one_time_begins_anew_but_noise_does_not() -> None:
    scene = SceneMemory()
    replay(scene, list(times(3)))
    assert [o.track_statuses for o in replay(scene, [times(3)[-1]], off=0.09)] == [[TrackStatus.KEPT]]
    assert [o.track_statuses for o in replay(scene, [times(3)[-1]], off=0.11)] == [[TrackStatus.RESET]]


@pytest.mark.parametrize("jump", [2.1, 3.04, 3600.0])
@pytest.mark.parametrize("step", [0.1, 0.5])
def test_a_clock_that_jumps_back_begins_anew(jump: float, step: float) -> None:
    scene = SceneMemory()
    moments = list(times(round(10 / step), step))
    replay(scene, moments, speed=1.0)
    back = [moments[-1] - jump + step * number for number in range(round(7 / step))]
    outcomes = replay(scene, back, speed=1.0, off=0.01)
    assert [outcome.track_statuses[0] for outcome in outcomes] == [TrackStatus.RESET] + [TrackStatus.KEPT] * (
        len(back) - 1
    )
    found = settled(outcomes)
    assert found
    assert all((row["made_at"] >= back[0]).all() for row in found.values())


def test_a_clock_that_jumps_back_a_little_is_seen_where_the_agent_is() -> None:
    scene = SceneMemory()
    replay(scene, list(times(20, 0.1)))
    step_back = times(20, 0.1)[9]
    at = observation(step_back, where(times(21, 0.1)[-1]))  # it has gone on meanwhile
    outcome = scene.apply(LogEntry(step_back, [TrackUpdate("a", b"v", at)]))
    assert outcome.track_statuses == [TrackStatus.RESET]


@pytest.mark.parametrize(("step", "jitter"), [(0.5, 0.04), (0.1, 0.02), (0.1, 0.049)])
def test_the_order_of_arrival_makes_no_difference_off_the_lags(step: float, jitter: float) -> None:
    rng = random.Random(7)
    moments = [t + rng.uniform(-jitter, jitter) for t in times(round(40 / step), step)]
    last = [moments[-1] + 0.5 * number for number in range(1, 6)]  # until all is settled
    in_order = settled(replay(SceneMemory(), [*moments, *last]))
    shuffled = sorted(moments, key=lambda t: t + rng.uniform(0, 1.9))
    found = settled(replay(SceneMemory(), [*shuffled, *last]))
    assert len(in_order) > 20 / step
    assert found.keys() == in_order.keys()
    assert all(found[key].tobytes() == in_order[key].tobytes() for key in found)


def test_who_is_always_late_is_as_well_known() -> None:
    scene = SceneMemory()
    rng = random.Random(3)
    outcomes = []
    for moment in times(80):
        t = moment + rng.uniform(-0.04, 0.04)
        outcomes.append(scene.apply(LogEntry(t, [track_update(t, "prompt")])))
        t = moment - 1.5 + rng.uniform(-0.04, 0.04)
        outcomes.append(scene.apply(LogEntry(t, [track_update(t, "late", off=9.0)])))
    counts = {name: sum(key[0] == name for key in settled(outcomes)) for name in ("prompt", "late")}
    assert counts["prompt"] > 60
    assert abs(counts["late"] - counts["prompt"]) <= 1  # at the end one of them has yet to wait


async def test_what_is_older_than_the_window_is_forgotten() -> None:
    scene = SceneMemory()
    replay(scene, list(times(12)))
    far = START + 5.5 + WINDOW + 0.1
    scene.apply(LogEntry(far, [track_update(far, "b")]))
    assert (await scene.snapshot(99.0))[0] == ["b"]
    (outcome,) = replay(scene, [far])
    assert outcome.track_statuses == [TrackStatus.NEW]


def test_memory_is_bounded() -> None:
    scene = SceneMemory()
    for number, moment in enumerate(times(3000, 0.01)):
        scene.apply(LogEntry(moment, [track_update(moment, model=f"m@{number % (MAX_MODELS + 5)}")]))
    track = scene._tracks["a"]
    assert len(track._forecasts) == MAX_MODELS
    assert all(len(history.times) <= MAX_FORECASTS for history in track._forecasts.values())
    assert all(history.times == sorted(history._forecasts) for history in track._forecasts.values())
    assert len(track._observations) <= WINDOW / 0.01 + 1


def test_histories_are_what_was_seen_up_to_the_call() -> None:
    scene = SceneMemory()
    moments = list(times(10))
    for moment in moments:
        scene.apply(LogEntry(moment, [track_update(moment, model="")]))

    def recalled(time: float, recall: float) -> list[float]:
        brought = TrackUpdate("a", b"v", observation(time, where(time)))
        (history,) = scene.apply(LogEntry(time, [brought]), history_s=recall).histories
        return np.frombuffer(history).reshape(-1, 9)[:, 0].tolist()  # type: ignore[no-any-return]

    assert recalled(moments[-1] + 0.5, 2.0) == [*moments[-4:], moments[-1] + 0.5]
    assert recalled(moments[7], 1.0) == moments[5:8]  # a late call sees nothing of what came after it
    assert recalled(moments[-1] + 0.5, 0.0) == [moments[-1] + 0.5]


def test_all_that_a_call_brings_goes_into_the_history() -> None:
    scene = SceneMemory()
    moments = list(times(4))
    packed = b"".join(observation(t, where(t)) for t in moments)
    outcome = scene.apply(LogEntry(moments[-1], [TrackUpdate("a", b"v", packed)]), history_s=5.0)
    assert outcome.histories == [packed]


@given(
    st.lists(
        st.tuples(
            st.integers(0, 60), st.sampled_from("ab"), st.sampled_from(["m@1", "n@1"]), st.floats(-0.05, 0.05)
        ),
        max_size=60,
    )
)
def test_nothing_is_settled_twice_or_without_every_age(
    calls: list[tuple[int, str, str, float]],
) -> None:
    scene = SceneMemory()
    outcomes = []
    for number, agent_id, model, jitter in calls:
        t = START + 0.5 * number + jitter
        outcomes.append(scene.apply(LogEntry(t, [track_update(t, agent_id, model=model, speed=1.0)])))
    for row in settled(outcomes).values():
        ages = row["time"] - row["made_at"]
        assert (np.abs(ages - 0.5 * np.arange(1, AGES + 1)) <= 0.0902).all()
