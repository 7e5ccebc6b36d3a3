"""Augmentation by rotation and by reflection."""

import numpy as np
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from model.data.augmentation import mirror, rotate
from model.data.protocols import frame_scene
from model.data.scenes import SceneRecord, Track
from model.features.agent_features import agent_frame_features
from model.features.neighbor_boxes import neighbor_boxes
from model.features.scene_features import ground_frame_features
from model.features.spec import Frame
from model.features.standardization import HEADING
from model.forecaster import Context, Features, Protocol
from model.networks.config import NetworkConfig
from model.networks.rasterize_boxes import rasterize_boxes
from model.scenes.scene import AgentType, Raster
from tests.model.data.records import record, turned

CONFIG = NetworkConfig()
VEHICLE = AgentType.VEHICLE


def _features(whole: SceneRecord, frame: int, index: int, protocol: Protocol) -> Features:
    scene, tracks = frame_scene(whole, frame, protocol, 5)
    target = np.flatnonzero(tracks == index)
    # The map stays aligned with the agent, whichever way the ground frame lies
    config = CONFIG.model_copy(update={"uses_map": False})
    return ground_frame_features(scene, target, AgentType.VEHICLE, config.features, Context.FULL)


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 5),
    frame=st.integers(1, 11),
    index=st.integers(0, 3),
    angle=st.floats(-10, 10),
    protocol=st.sampled_from(Protocol),
)
def test_turning_features_is_turning_the_scene(
    seed: int, frame: int, index: int, angle: float, protocol: Protocol
) -> None:
    whole = record(seed=seed)
    one = whole.tracks[index]
    if frame not in one.frames or frame == one.frames[0]:
        return
    now = one.frames.tolist().index(frame)
    other = turned(whole, angle, one.position[now])
    future = torch.from_numpy(one.position[now + 1 : now + 13] - one.position[now])[None].float()
    moved = other.tracks[index].position
    given_features = _features(whole, frame, index, protocol)
    got, got_future = rotate(given_features, future, torch.tensor([angle], dtype=torch.float64))
    wanted = _features(other, frame, index, protocol)
    assert got.keys() == wanted.keys()
    # Present headings at −π and π are the same
    apart = got["history"][..., HEADING] - wanted["history"][..., HEADING]
    jump = 2 * torch.round(apart[:, -1:] / 2)
    got["history"][..., HEADING] -= torch.where(
        torch.arange(5) >= got["first"][:, None], jump, torch.zeros(1)
    )
    for name, value in wanted.items():
        np.testing.assert_allclose(got[name].numpy(), value.numpy(), rtol=1e-4, atol=2e-5, err_msg=name)
        assert got[name].dtype == value.dtype
    np.testing.assert_allclose(got_future[0].numpy(), moved[now + 1 : now + 13] - moved[now], atol=1e-4)


def test_each_agent_turns_by_its_own_angle_and_nothing_given_changes() -> None:
    whole = record(seed=2)
    parts = [_features(whole, 9, index, Protocol.CAUSAL) for index in range(4)]
    features = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    features["map"] = torch.randn(4, 3, 100, 100)
    before = {name: value.clone() for name, value in features.items()}
    future = torch.randn(4, 12, 2)
    angles = torch.tensor([0.0, 1.0, -2.0, 5.0])
    got, got_future = rotate(features, future, angles)
    for index in range(4):
        alone, alone_future = rotate(parts[index], future[index : index + 1], angles[index : index + 1])
        torch.testing.assert_close(got_future[index], alone_future[0])
        for name, value in alone.items():
            torch.testing.assert_close(got[name][index], value[0])
    assert got["map"] is features["map"]
    for name, value in before.items():
        assert torch.equal(features[name], value)
    torch.testing.assert_close(got["history"][0], features["history"][0])


def test_a_quarter_turn() -> None:
    features = {
        "history": torch.zeros(1, 2, 8),
        "first": torch.tensor([1]),
        "velocity": torch.tensor([[3.0, 0.0]]),
    }
    features["history"][0, 1] = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.75, 0.3])
    got, future = rotate(features, torch.tensor([[[1.0, 2.0]]]), torch.tensor([np.pi / 2]))
    wanted = torch.tensor([-2.0, 1.0, -4.0, 3.0, -6.0, 5.0, -0.75, 0.3])
    torch.testing.assert_close(got["history"][0, 1], wanted)
    assert not got["history"][0, 0].any()
    torch.testing.assert_close(got["velocity"], torch.tensor([[0.0, 3.0]]))
    torch.testing.assert_close(future, torch.tensor([[[-2.0, 1.0]]]))


def reflected(scene: SceneRecord) -> SceneRecord:
    """Return the record with y for −y, its raster too."""
    tracks = [
        Track(one.id, one.type, one.frames, one.position * np.array([1.0, -1.0]), -one.heading)
        for one in scene.tracks
    ]
    given = scene.raster
    last = given.origin[1] + (given.layers.shape[2] - 1) / given.pixels_per_meter
    layers = np.ascontiguousarray(given.layers[:, :, ::-1])
    origin = np.array([given.origin[0], -last])
    return SceneRecord(scene.name, tracks, scene.pairs, Raster(layers, origin, given.pixels_per_meter))


def _features_and_future(
    whole: SceneRecord, frame: int, index: int, protocol: Protocol
) -> tuple[Features, torch.Tensor]:
    """Return features of a track at a frame, boxes of the agents around among them, and its future."""
    scene, tracks = frame_scene(whole, frame, protocol, 5)
    target = np.flatnonzero(tracks == index)
    features = ground_frame_features(scene, target, VEHICLE, CONFIG.features, Context.FULL)
    features["neighbor_boxes"] = torch.from_numpy(neighbor_boxes(scene, target, CONFIG.neighbor_types))
    one = whole.tracks[index]
    now = one.frames.tolist().index(frame)
    future = one.position[now + 1 : now + 13] - one.position[now]
    return features, torch.from_numpy(future)[None].float()


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 5),
    frame=st.integers(1, 11),
    index=st.integers(0, 3),
    protocol=st.sampled_from(Protocol),
)
def test_mirroring_features_is_mirroring_the_scene(
    seed: int, frame: int, index: int, protocol: Protocol
) -> None:
    whole = record(seed=seed)
    one = whole.tracks[index]
    assume(frame in one.frames and frame != one.frames[0])
    given_features, future = _features_and_future(whole, frame, index, protocol)
    before = {name: value.clone() for name, value in given_features.items()}
    got, got_future = mirror(given_features, future, torch.tensor([True]))
    wanted, wanted_future = _features_and_future(reflected(whole), frame, index, protocol)
    assert got.keys() == wanted.keys()
    torch.testing.assert_close(got_future, wanted_future, rtol=0, atol=1e-4)
    # The agent is elsewhere, and in the patch there is no column to the far right's left
    for name in got.keys() - {"origin", "map"}:
        np.testing.assert_allclose(got[name], wanted[name], rtol=1e-4, atol=2e-5, err_msg=name)
        assert got[name].dtype == wanted[name].dtype
    assert torch.equal(got["map"][..., 0], got["map"][..., 1])
    off = (got["map"] - wanted["map"])[..., 1:].abs()
    # Raster pixels lie on the same points up to rounding: an edge may fall to its other side
    assert off.mean() < 1e-3
    drawn = rasterize_boxes(got["neighbor_boxes"]) - rasterize_boxes(wanted["neighbor_boxes"])
    assert drawn.abs().max() < 1e-3
    for name, value in before.items():
        assert torch.equal(given_features[name], value)


def test_only_the_chosen_are_mirrored_and_twice_is_not_at_all() -> None:
    parts = [_features_and_future(record(seed=2), 9, index, Protocol.CAUSAL) for index in range(4)]
    features = {name: torch.cat([part[name] for part, _ in parts]) for name in parts[0][0]}
    future = torch.cat([one for _, one in parts])
    chosen = torch.tensor([True, False, True, False])
    once, once_future = mirror(features, future, chosen)
    twice, twice_future = mirror(once, once_future, chosen)
    assert torch.equal(once_future[~chosen], future[~chosen])
    assert not torch.equal(once_future[chosen], future[chosen])
    assert torch.equal(twice_future, future)
    for name, value in features.items():
        assert torch.equal(once[name][~chosen], value[~chosen]), name
        if name == "map":
            assert torch.equal(twice[name][..., 1:], value[..., 1:])
        else:
            assert torch.equal(twice[name], value), name
    assert not torch.equal(once["history"][chosen][..., HEADING], features["history"][chosen][..., HEADING])


def test_mirroring_features_in_the_agents_frame_is_mirroring_the_scene() -> None:
    config = NetworkConfig(frame=Frame.AGENT)
    for seed in range(4):
        whole = record(seed=seed)
        features = []
        for scene in (whole, reflected(whole)):
            seen, tracks = frame_scene(scene, 8, Protocol.CAUSAL, 5)
            features.append(
                agent_frame_features(seen, np.flatnonzero(tracks == 0), config.features, Context.FULL)
            )
        here, there = features
        future = torch.randn(1, 12, 2)
        mirrored, its_future = mirror(here, future, torch.tensor([True]))
        for name in ("speed", "history", "neighbors", "heading"):
            turn = (
                torch.sin(mirrored[name] - there[name]) if name == "heading" else mirrored[name] - there[name]
            )
            assert turn.abs().max() < 1e-5, name
        torch.testing.assert_close(its_future, future * torch.tensor([1.0, -1.0]))
        # The column that has no partner, and half a pixel at edges, may differ
        off = (mirrored["map"] - there["map"])[..., 1:].abs() > 0.05
        assert off.float().mean() < 0.02
        same, _ = mirror(here, future, torch.tensor([False]))
        for name, values in here.items():
            torch.testing.assert_close(same[name], values)
