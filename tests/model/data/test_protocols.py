"""Frames of recorded scenes under both protocols."""

from dataclasses import replace

import numpy as np
import pytest

from model.data.protocols import SceneFrames, frame_scene
from model.data.scenes import Pair, SceneRecord, Track
from model.forecaster import Protocol
from model.geometry import wrap_angle
from model.scenes.resample import resample
from model.scenes.scene import AgentStates, AgentType
from tests.model.builders import observations
from tests.model.data.records import raster, record, track

FRAMES = 5
FIELDS = ("position", "velocity", "acceleration", "heading", "heading_rate", "first")


def _scene(*tracks: Track) -> SceneRecord:
    return SceneRecord("scene-1", tracks, [Pair(0, 4)], raster())


def _same(a: AgentStates, b: AgentStates) -> None:
    for name in FIELDS:
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-9, err_msg=name)


@pytest.mark.parametrize("frame", [0, 1, 4, 5, 6, 8, 13, 23])
@pytest.mark.parametrize("frames", [1, 5, 9])
def test_causal_is_what_the_server_makes_of_the_whole_past(frame: int, frames: int) -> None:
    whole = record(seed=3)
    scene, tracks = frame_scene(whole, frame, Protocol.CAUSAL, frames)
    sent = []
    for index in tracks:
        one = whole.tracks[index]
        past = one.frames <= frame
        sent.append(
            {
                "time": one.frames[past] * 0.5,
                "position": one.position[past],
                "heading": one.heading[past],
            }
        )
    if sent:
        _same(scene.states, resample(observations(sent), frame * 0.5, frames))
    seen_before = [i for i, one in enumerate(whole.tracks) if frame in one.frames and one.frames[0] < frame]
    assert tracks.tolist() == seen_before
    assert list(scene.types) == [whole.tracks[index].type for index in tracks]
    assert scene.raster is whole.raster


def test_causal_does_not_see_what_comes_later() -> None:
    whole = record(seed=4)
    changed = [replace(one, position=one.position.copy()) for one in whole.tracks]
    for one in changed:
        one.position[one.frames > 10] += 7.0
    before, _ = frame_scene(whole, 10, Protocol.CAUSAL, FRAMES)
    after, _ = frame_scene(replace(whole, tracks=changed), 10, Protocol.CAUSAL, FRAMES)
    _same(before.states, after.states)
    paper, _ = frame_scene(whole, 10, Protocol.PAPER, FRAMES)
    leaked, _ = frame_scene(replace(whole, tracks=changed), 10, Protocol.PAPER, FRAMES)
    assert not np.allclose(paper.states.velocity[:, -1], leaked.states.velocity[:, -1])


def test_paper_differentiates_centrally_over_the_whole_track() -> None:
    whole = record(seed=5)
    one = whole.tracks[0]
    velocity = np.gradient(one.position, 0.5, axis=0)
    acceleration = np.gradient(velocity, 0.5, axis=0)
    rate = np.gradient(np.unwrap(one.heading), 0.5)
    for frame in (0, 1, 7, 23):
        states = frame_scene(whole, frame, Protocol.PAPER, FRAMES)[0].states
        past = slice(max(frame - 4, 0), frame + 1)
        shown = slice(-len(velocity[past]), None)
        np.testing.assert_allclose(states.position[0, shown], one.position[past])
        np.testing.assert_allclose(states.velocity[0, shown], velocity[past], atol=1e-9)
        np.testing.assert_allclose(states.acceleration[0, shown], acceleration[past], atol=1e-9)
        np.testing.assert_allclose(states.heading_rate[0, shown], rate[past], atol=1e-9)
        np.testing.assert_allclose(wrap_angle(states.heading[0, shown] - one.heading[past]), 0, atol=1e-9)


def test_paper_differentiates_within_unbroken_runs() -> None:
    frames = [0, 1, 2, 4, 5, 8]
    x = np.array([0.0, 1.0, 3.0, 20.0, 24.0, 100.0])
    one = track("a", np.stack([x, 0 * x], axis=-1), frames=frames)
    seen = {
        frame: frame_scene(_scene(one), frame, Protocol.PAPER, 1)[0].states.velocity[0, 0, 0]
        for frame in frames
    }
    assert seen == pytest.approx({0: 2.0, 1: 3.0, 2: 4.0, 4: 8.0, 5: 8.0, 8: 0.0})


def test_headings_turn_by_the_shorter_arc() -> None:
    one = track("a", np.zeros((5, 2)), wrap_angle(np.array([3.0, 3.1, 3.2, 3.3, 3.4])))
    for protocol in Protocol:
        states = frame_scene(_scene(one), 3, protocol, FRAMES)[0].states
        np.testing.assert_allclose(states.heading_rate[0, 1:], 0.2, atol=1e-9)


def test_who_is_there() -> None:
    line = np.stack([np.arange(6.0), np.zeros(6)], axis=-1)
    gone = track("gone", line[:3])
    coming = track("coming", line[:2], frames=[5, 6])
    first_seen = track("first", line[:3], frames=[4, 5, 6])
    walker = track("walker", line, kind=AgentType.PEDESTRIAN)
    whole = _scene(gone, track("car", line), coming, first_seen, walker)
    scene, tracks = frame_scene(whole, 4, Protocol.CAUSAL, FRAMES)
    assert tracks.tolist() == [1, 4]
    assert list(scene.types) == [AgentType.VEHICLE, AgentType.PEDESTRIAN]
    assert tracks.dtype == np.int64
    # Its velocity is known from what comes later
    assert frame_scene(whole, 4, Protocol.PAPER, FRAMES)[1].tolist() == [1, 3, 4]


@pytest.mark.parametrize("protocol", list(Protocol))
@pytest.mark.parametrize("frame", [-3, 100])
def test_nobody_is_there_outside_the_record(protocol: Protocol, frame: int) -> None:
    scenes = SceneFrames(record(), protocol, FRAMES)
    scene, tracks = scenes.at(frame)
    assert len(tracks) == len(scene.types) == 0
    assert scene.states.position.shape == (0, FRAMES, 2)


def test_a_record_without_tracks() -> None:
    assert len(frame_scene(SceneRecord("empty", [], [], raster()), 0, Protocol.PAPER, FRAMES)[1]) == 0
