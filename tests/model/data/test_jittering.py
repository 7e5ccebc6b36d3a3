"""Histories and maps moved a little."""

import math

import pytest
import torch

from loadtest.forward import features_in_agent_frame
from model.data import jittering
from model.data.jittering import MAX_SHIFT_M, MAX_STRETCH, jitter, moved, stretched
from model.networks.agent_frame import read_patch
from model.scenes.raster import FAR, NEAR


def test_a_history_is_noisy_where_it_was_observed_and_ends_at_the_origin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(jittering, "MAX_STRETCH", 0.0)
    torch.manual_seed(0)
    features = features_in_agent_frame(64)
    features["first"] = torch.arange(64) % 5
    jittered = jitter(features, torch.zeros(64, 12, 2))[0]["history"]
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
        seen = moved(patch, turn, shift, torch.ones(1), geometry)
        point = torch.tensor([[8.0]]), torch.tensor([[-3.0]])
        cos, sin = math.cos(0.05), math.sin(0.05)
        x = cos * point[0] - sin * point[1] + shift[0, 0]
        y = sin * point[0] + cos * point[1] + shift[0, 1]
        torch.testing.assert_close(
            read_patch(seen, *point, geometry), read_patch(patch, x, y, geometry), atol=0.02, rtol=0
        )


def test_no_move_changes_nothing() -> None:
    patch = torch.rand(2, 3, 100, 100)
    same = moved(patch, torch.zeros(2), torch.zeros(2, 2), torch.ones(2), FAR)
    torch.testing.assert_close(same, patch, atol=1e-4, rtol=0)


def test_some_maps_lose_dividers_and_unknown_ground_stays_unknown() -> None:
    torch.manual_seed(0)
    features = features_in_agent_frame(200)
    for name in ("map", "far_map"):
        features[name] = torch.ones(200, 3, 100, 100)
        features[name][:, :, 80:] = 0.0
    jittered, _ = jitter(features, torch.zeros(200, 12, 2))
    for layer in (1, 2):
        bare = (jittered["far_map"][:, layer, 20:60, 20:80] == -1).flatten(1).all(dim=1)
        assert 0.03 < bare.float().mean() < 0.2
    assert (jittered["far_map"][:, 0, 20:60, 20:80] > 0.999).all()
    assert (jittered["far_map"][:, :, 97:, 40:60] == 0).all()
    # so that the rows looked at above lie within and without
    assert 14 + 66 * (1 - MAX_STRETCH) - MAX_SHIFT_M * FAR.pixels_per_meter > 60
    assert 14 + 66 * (1 + MAX_STRETCH) + MAX_SHIFT_M * FAR.pixels_per_meter < 97


def test_a_stretched_scene_is_the_same_scene_in_another_size() -> None:
    torch.manual_seed(0)
    features, future = features_in_agent_frame(3), torch.randn(3, 12, 2)
    scaled, path = stretched(features, future, torch.tensor([0, 2]), torch.tensor([0.8, 1.25]))
    factor = torch.tensor([0.8, 1.0, 1.25])
    torch.testing.assert_close(path, factor[:, None, None] * future)
    torch.testing.assert_close(scaled["speed"], factor * features["speed"])
    history, before = scaled["history"], features["history"]
    torch.testing.assert_close(history[..., :6], factor[:, None, None] * before[..., :6])
    torch.testing.assert_close(history[..., 6:], before[..., 6:])
    neighbors, before = scaled["neighbors"], features["neighbors"]
    for column, grows in enumerate([True, True, False, False, True, True, True, True, False, False, False]):
        expected = before[..., column] * (factor[:, None] if grows else 1.0)
        torch.testing.assert_close(neighbors[..., column], expected)
    for geometry in (NEAR, FAR):
        smooth = torch.nn.functional.interpolate(torch.rand(1, 3, 9, 9), size=(100, 100), mode="bicubic")
        for size in (0.8, 1.25):
            patch = moved(smooth, torch.zeros(1), torch.zeros(1, 2), torch.tensor([size]), geometry)
            x, y = torch.tensor([[8.0]]), torch.tensor([[-3.0]])
            torch.testing.assert_close(
                read_patch(patch, size * x, size * y, geometry),
                read_patch(smooth, x, y, geometry),
                atol=0.02,
                rtol=0,
            )
