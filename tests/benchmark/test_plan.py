"""Plans: every pair and every full history is requested once."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmark.plan import HISTORY_FRAMES, digest, full_history, plan_scenes
from model.data.scenes import DataError
from tests.benchmark.scenes import PAIRS, READER, RECORDS, planned
from tests.model.data.records import FixedReader


def test_every_pair_is_due_once() -> None:
    scenes = planned()
    assert [scene.first for scene in scenes] == [0, len(RECORDS[0].pairs)]
    for scene, record in zip(scenes, RECORDS, strict=True):
        due = [(track, call.frame) for call in scene.calls for track in sorted(call.due)]
        assert due == [(pair.track, pair.frame) for pair in record.pairs]
        assert len({call.frame for call in scene.calls}) == len(scene.calls)
        assert all(call.due <= set(call.tracks) for call in scene.calls)


def test_every_full_history_of_the_challenges_agents_is_requested() -> None:
    (scene, _) = planned()
    requested = {(track, call.frame) for call in scene.calls for track in call.tracks}
    for index, track in enumerate(scene.record.tracks):
        frames = set(track.frames.tolist())
        for frame in frames:
            full = all(frame - back in frames for back in range(HISTORY_FRAMES))
            wanted = (full and track.id != "a4") or (index, frame) in {
                (pair.track, pair.frame) for pair in scene.pairs
            }
            assert ((index, frame) in requested) == wanted, (track.id, frame)
    assert scene.forecasts == len(requested)


def test_without_consistency_only_pairs_are_requested() -> None:
    assert sum(scene.forecasts for scene in planned(consistency=False)) == PAIRS


@pytest.mark.parametrize("limit", [1, 7, len(RECORDS[0].pairs), len(RECORDS[0].pairs) + 3, PAIRS + 9])
def test_the_limit_takes_the_first_pairs(limit: int) -> None:
    scenes = planned(limit=limit)
    assert sum(len(scene.pairs) for scene in scenes) == min(limit, PAIRS)
    all_pairs = [pair for record in RECORDS for pair in record.pairs]
    assert [pair for scene in scenes for pair in scene.pairs] == all_pairs[:limit]


def test_truth_and_origin_are_where_the_agents_are() -> None:
    (scene, _) = planned()
    pair = scene.pairs[5]
    track = scene.record.tracks[pair.track]
    now = track.frames.tolist().index(pair.frame)
    np.testing.assert_array_equal(scene.origin()[5], track.position[now])
    np.testing.assert_array_equal(scene.truth()[5], track.position[now + 1 : now + 13])


def test_another_plan_or_other_data_has_another_digest() -> None:
    first = digest(planned())
    assert digest(planned()) == first
    moved = replace(RECORDS[0].tracks[0], position=RECORDS[0].tracks[0].position + 1e-6)
    other = replace(RECORDS[0], tracks=[moved, *RECORDS[0].tracks[1:]])
    others = [
        planned(consistency=False),
        planned(limit=3),
        list(plan_scenes(FixedReader(other, RECORDS[1]), "some")),
        list(plan_scenes(FixedReader(RECORDS[0]), "some")),
    ]
    assert first not in map(digest, others)


def test_no_pairs_are_no_benchmark() -> None:
    with pytest.raises(DataError, match="'none' has no pairs"):
        list(plan_scenes(READER, "none"))


@given(st.sets(st.integers(0, 30)))
def test_a_full_history_has_no_gap(frames: set[int]) -> None:
    found = full_history(np.array(sorted(frames), dtype=np.int64)).tolist()
    assert found == [f for f in sorted(frames) if all(f - back in frames for back in range(HISTORY_FRAMES))]
