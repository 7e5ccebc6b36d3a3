"""Histories and maps moved a little."""

import math

import torch

from model.bench import features_in_agent_frame
from model.data.jittering import MAX_SHIFT_M, jitter, moved
from model.networks.agent_frame import read_patch
from model.raster import FAR, NEAR


def test_a_history_is_noisy_where_it_was_observed_and_ends_at_the_origin() -> None:
    torch.manual_seed(0)
    features = features_in_agent_frame(64)
    features["first"] = torch.arange(64) % 5
    jittered = jitter(dict(features))["history"]
    noise = jittered - features["history"]
    for agent in range(64):
        before = noise[agent, : int(features["first"][agent])]
        assert before.numel() == 0 or before.abs().max() == 0
    assert noise[:, -1, [0, 1, 6]].abs().max() == 0
    assert 0 < noise[:, -1, 2].std() < 0.007
    assert noise[:, :, 4].abs().max() < 0.07 * 5


def test_a_moved_patch_shows_the_same_ground_from_another_pose() -> None:
    torch.manual_seed(0)
    turn, shift = torch.tensor([0.05]), torch.tensor([[0.3, -0.4]])
    for geometry in (NEAR, FAR):
        smooth = torch.rand(1, 3, 9, 9)
        patch = torch.nn.functional.interpolate(smooth, size=(100, 100), mode="bicubic")
        seen = moved(patch, turn, shift, geometry)
        point = torch.tensor([[8.0]]), torch.tensor([[-3.0]])
        cos, sin = math.cos(0.05), math.sin(0.05)
        x = cos * point[0] - sin * point[1] + shift[0, 0]
        y = sin * point[0] + cos * point[1] + shift[0, 1]
        torch.testing.assert_close(
            read_patch(seen, *point, geometry), read_patch(patch, x, y, geometry), atol=0.02, rtol=0
        )


def test_no_move_changes_nothing() -> None:
    patch = torch.rand(2, 3, 100, 100)
    same = moved(patch, torch.zeros(2), torch.zeros(2, 2), FAR)
    torch.testing.assert_close(same, patch, atol=1e-4, rtol=0)


def test_some_maps_lose_dividers_and_unknown_ground_stays_unknown() -> None:
    torch.manual_seed(0)
    features = features_in_agent_frame(200)
    for name in ("map", "far_map"):
        features[name] = torch.ones(200, 3, 100, 100)
        features[name][:, :, 80:] = 0.0
    jittered = jitter(features)
    for layer in (1, 2):
        bare = (jittered["far_map"][:, layer, 20:60, 20:80] == -1).flatten(1).all(dim=1)
        assert 0.03 < bare.float().mean() < 0.2
    assert (jittered["far_map"][:, 0, 20:60, 20:80] > 0.999).all()
    assert (jittered["far_map"][:, :, 90:, 40:60] == 0).all()
    assert MAX_SHIFT_M * FAR.pixels_per_meter < 5  # so that the rows looked at above lie within
