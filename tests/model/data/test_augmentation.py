"""Augmentation by rotation."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from model.data.augmentation import rotate
from model.data.protocols import frame_scene
from model.data.scenes import SceneRecord
from model.features.scene_features import ground_frame_features
from model.features.standardization import HEADING
from model.forecaster import Context, Features, Protocol
from model.networks.config import NetworkConfig
from model.scenes.scene import AgentType
from tests.model.data.records import record, turned

CONFIG = NetworkConfig()


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
