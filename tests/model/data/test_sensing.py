"""Noisy reports of recorded tracks."""

from dataclasses import replace

import numpy as np
import pytest

from model.data.protocols import SceneFrames
from model.data.scenes import SceneRecord
from model.data.sensing import SensedFrames, spline
from model.forecaster import Protocol
from tests.model.data.records import record

FRAME = 11
FRAMES = 5


def _changed_after(scene: SceneRecord, frame: int) -> SceneRecord:
    """Return the record with another future."""
    tracks = [
        replace(
            one,
            position=one.position + 50.0 * (one.frames > frame)[:, None],
            heading=one.heading + 1.0 * (one.frames > frame),
        )
        for one in scene.tracks
    ]
    return replace(scene, tracks=tracks)


def test_reports_show_who_is_there_near_where_they_are() -> None:
    scene = record()
    recorded, tracks = SceneFrames(scene, Protocol.CAUSAL, FRAMES).at(FRAME)
    sensed = SensedFrames(scene, FRAMES, seed=3)
    offsets, turns = [], []
    for variant in range(1, 40):
        seen, same = sensed.at(FRAME, variant)
        np.testing.assert_array_equal(same, tracks)
        assert seen.types == recorded.types
        states = seen.states
        assert states.velocity_known.all()
        assert np.isfinite(states.heading[:, -1]).all()
        offsets.append(np.linalg.norm(states.position[:, -1] - recorded.states.position[:, -1], axis=-1))
        turns.append(np.cos(states.heading[:, -1] - recorded.states.heading[:, -1]))
    assert 0.005 < np.median(offsets) < 0.1
    assert np.max(offsets) < 1.5  # carried to the present where the newest report is old
    assert np.mean(np.array(turns) > 0.95) > 0.8


def test_what_comes_after_now_is_in_no_report() -> None:
    scene = record()
    one, other = (SensedFrames(each, FRAMES, seed=3) for each in (scene, _changed_after(scene, FRAME)))
    for variant in range(1, 25):
        here, there = one.at(FRAME, variant)[0].states, other.at(FRAME, variant)[0].states
        for name in ("position", "velocity", "acceleration", "heading", "heading_rate"):
            np.testing.assert_array_equal(getattr(here, name), getattr(there, name), err_msg=name)


def test_a_report_depends_on_seed_frame_and_variant_alone() -> None:
    scene = record()
    first, again = (SensedFrames(scene, FRAMES, seed=3) for _ in range(2))
    again.at(FRAME - 1, 1)
    here, there = first.at(FRAME, 2)[0].states, again.at(FRAME, 2)[0].states
    np.testing.assert_array_equal(here.position, there.position)
    other = first.at(FRAME, 3)[0].states
    assert not np.array_equal(here.position, other.position)
    another_seed = SensedFrames(scene, FRAMES, seed=4).at(FRAME, 2)[0].states
    assert not np.array_equal(here.position, another_seed.position)


def test_some_reports_are_of_agents_first_seen_a_moment_ago() -> None:
    scene = record()
    sensed = SensedFrames(scene, FRAMES, seed=3)
    first = np.concatenate([sensed.at(FRAME, variant)[0].states.first for variant in range(1, 60)])
    assert {0, 1, 2, 3, 4} <= set(first.tolist())


def test_the_spline_is_exact_for_steady_acceleration_and_meets_its_poses() -> None:
    seconds = 0.5 * np.arange(-5, 1)
    positions = np.stack([10 * seconds + 0.75 * seconds**2, -0.5 * seconds**2], axis=-1)
    ages = np.linspace(2.0, 0.0, 21)
    place, velocity = spline(positions, ages)
    np.testing.assert_allclose(place, np.stack([-10 * ages + 0.75 * ages**2, -0.5 * ages**2], -1), atol=1e-9)
    np.testing.assert_allclose(velocity, np.stack([10 - 1.5 * ages, ages], axis=-1), atol=1e-9)
    wild = np.random.default_rng(0).normal(size=(6, 2))
    np.testing.assert_allclose(spline(wild, np.array([1.0, 0.5, 0.0]))[0], wild[-3:], atol=1e-12)


def test_one_pose_tells_no_velocity() -> None:
    place, velocity = spline(np.array([[3.0, 4.0]]), np.zeros(2))
    assert place.tolist() == [[3.0, 4.0]] * 2
    assert np.isnan(velocity).all()


@pytest.mark.parametrize("variant", [1, 2])
def test_a_gap_in_the_past_is_not_bridged(variant: int) -> None:
    scene = record()
    alone = replace(scene, tracks=[scene.tracks[1]], pairs=[])  # it was not annotated at frame 5
    states = SensedFrames(alone, FRAMES, seed=0).at(7, variant)[0].states
    assert (states.first >= FRAMES - 3).all() or (states.first == 0).all()
    assert np.isfinite(states.position[:, -1]).all()
