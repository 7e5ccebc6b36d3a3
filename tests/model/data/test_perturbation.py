"""Jitter, dropped context, standing agents that stay, and stopped vehicles in the way."""

import math

import pytest
import torch

from loadtest.forward import features_in_agent_frame
from model.data import perturbation
from model.data.packing import UNKNOWN, unpack_patches
from model.data.perturbation import (
    BLOCKED,
    GAP_M,
    JITTERED,
    LATERAL_OFFSET_M,
    MAX_SHIFT_M,
    MAX_STRETCH,
    drop_context,
    drop_dividers,
    insert_stopped_vehicles,
    jitter,
    keep_standing,
    moved,
    scaled,
)
from model.features.agent_features import NEIGHBOR_POSITION_SCALE, NEIGHBOR_REACH_M, NEIGHBORS
from model.forecaster import Features
from model.networks.agent_frame import read_patch
from model.scenes.raster import FAR, NEAR

COUNT = 4000


def test_a_history_is_noisy_where_it_was_observed_and_ends_at_the_origin(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(perturbation, "MAX_STRETCH", 0.0)
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
    features = _packed_features()
    packed = features["far_map"]
    packed[:] = 3 | 3 << 2 | 3 << 4  # all layers present
    packed[:, 15:] = UNKNOWN
    shown = unpack_patches(drop_dividers(features)["far_map"])
    for layer in (1, 2):
        bare = (shown[:, layer, :15] == -1).flatten(1).all(dim=1)
        assert abs(bare.float().mean() - perturbation.NO_DIVIDERS) < 0.02
        assert (shown[~bare, layer, :15] == 1).all()
    assert (shown[:, 0, :15] == 1).all()
    assert (shown[:, :, 15:] == 0).all()
    assert (packed[:, :15] == 63).all()


def test_about_half_of_the_maps_are_moved_and_unknown_ground_stays_unknown() -> None:
    features = features_in_agent_frame(200)
    for name in ("map", "far_map"):
        features[name] = torch.ones(200, 3, 100, 100)
        features[name][:, :, 80:] = 0.0
    before = features["far_map"].clone()
    first = []
    for seed in range(6):
        torch.manual_seed(seed)
        seen = jitter(features | {"far_map": before.clone()}, torch.zeros(200, 12, 2))[0]["far_map"]
        changed = (seen != before).flatten(1).any(dim=1)
        assert abs(changed.float().mean() - JITTERED) < 0.15
        first.append(bool(changed[0]))
        assert (seen[:, 0, 20:60, 20:80] > 0.999).all()
        assert (seen[:, :, 97:, 40:60] == 0).all()
    assert set(first) == {True, False}
    # so that the rows looked at above lie within and without
    assert 14 + 66 * (1 - MAX_STRETCH) - MAX_SHIFT_M * FAR.pixels_per_meter > 60
    assert 14 + 66 * (1 + MAX_STRETCH) + MAX_SHIFT_M * FAR.pixels_per_meter < 97


def test_a_stretched_scene_is_the_same_scene_in_another_size() -> None:
    torch.manual_seed(0)
    features, future = features_in_agent_frame(3), torch.randn(3, 12, 2)
    other, path = scaled(features, future, slice(0, 3), torch.tensor([0.8, 1.0, 1.25]))
    factor = torch.tensor([0.8, 1.0, 1.25])
    torch.testing.assert_close(path, factor[:, None, None] * future)
    torch.testing.assert_close(other["speed"], factor * features["speed"])
    history, before = other["history"], features["history"]
    torch.testing.assert_close(history[..., :6], factor[:, None, None] * before[..., :6])
    torch.testing.assert_close(history[..., 6:], before[..., 6:])
    neighbors, before = other["neighbors"], features["neighbors"]
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


def _packed_features() -> Features:
    features = features_in_agent_frame(2)
    packed = torch.full((COUNT, 20, 20), 21, dtype=torch.uint8)
    repeated = {name: values[:1].expand(COUNT, *values.shape[1:]) for name, values in features.items()}
    return repeated | {"map": packed, "far_map": packed.clone()}


def test_shares_of_what_is_hidden() -> None:
    torch.manual_seed(0)
    features = _packed_features()
    hidden = drop_context(features)
    no_near, no_far = ((hidden[name] == UNKNOWN).flatten(1).all(dim=1).float() for name in ("map", "far_map"))
    assert abs(no_near.mean() - (perturbation.NO_MAP + perturbation.NO_NEAR_MAP)) < 0.015
    assert abs(no_far.mean() - (perturbation.NO_MAP + perturbation.NO_FAR_MAP)) < 0.02
    assert abs((no_near * no_far).mean() - perturbation.NO_MAP) < 0.015
    alone = (hidden["neighbors"] == 0).flatten(1).all(dim=1).float()
    assert abs(alone.mean() - perturbation.NO_NEIGHBORS) < 0.015


def test_a_short_map_ends_at_a_row_and_is_whole_before_it() -> None:
    torch.manual_seed(0)
    hidden = drop_context(_packed_features())["far_map"]
    unknown = hidden == UNKNOWN
    short = unknown.flatten(1).any(dim=1) & ~unknown.flatten(1).all(dim=1)
    assert abs(short.float().mean() - perturbation.SHORT_MAP) < 0.02
    rows = unknown[short]
    assert (rows.all(dim=2) == rows.any(dim=2)).all()  # whole rows
    first = rows.all(dim=2).int().argmax(dim=1)
    assert first.min() >= 5
    assert (rows.all(dim=2).sum(dim=1) == 20 - first).all()  # and all behind the first


def test_what_is_given_stays_as_it_is_and_unknown_reads_as_zero() -> None:
    torch.manual_seed(0)
    features = _packed_features()
    before = {name: values.clone() for name, values in features.items()}
    hidden = drop_context(features)
    for name, values in before.items():
        assert torch.equal(features[name], values), name
    for name in features.keys() - {"map", "far_map", "neighbors"}:
        assert hidden[name] is features[name]
    gone = (hidden["map"] == UNKNOWN).flatten(1).all(dim=1)
    assert unpack_patches(hidden["map"][gone]).abs().max() == 0


def test_most_of_those_who_leave_stay_and_nobody_else_changes() -> None:
    future = torch.randn(COUNT, 12, 2)
    leaving = torch.arange(COUNT) % 2 == 0
    held = keep_standing(future, leaving, 0.1, torch.Generator().manual_seed(0))
    changed = (held != future).any(dim=2).any(dim=1)
    assert not changed[~leaving].any()
    assert (held[changed] == 0).all()
    assert changed[leaving].float().mean().item() == pytest.approx(0.9, abs=0.03)
    again = keep_standing(future, leaving, 0.1, torch.Generator().manual_seed(0))
    assert torch.equal(held, again)


@pytest.mark.parametrize(("share", "stay"), [(0.0, True), (1.0, False)])
def test_all_stay_or_all_leave(share: float, stay: bool) -> None:
    future = torch.ones(50, 12, 2)
    held = keep_standing(future, torch.ones(50, dtype=torch.bool), share, torch.Generator().manual_seed(0))
    assert (held == 0).all().item() is stay


def alone(count: int) -> Features:
    """Return features of agents with no neighbour but the first one."""
    features = features_in_agent_frame(count)
    features["neighbors"][:, 1:] = 0.0
    return features


def test_some_get_a_vehicle_that_stands_beyond_where_they_went() -> None:
    torch.manual_seed(0)
    features = alone(COUNT)
    turn = torch.linspace(-1.0, 1.0, COUNT)
    direction = torch.stack([turn.cos(), turn.sin()], dim=-1)
    future = direction[:, None] * 1.5 * torch.arange(1, 13)[:, None]
    before = features["neighbors"].clone()
    neighbors = insert_stopped_vehicles(features, future)["neighbors"]
    assert torch.equal(features["neighbors"], before)
    new = neighbors[:, 1]
    there = new[:, -1] > 0
    assert there.float().mean().item() == pytest.approx(BLOCKED, abs=0.02)
    assert torch.equal(neighbors[:, 0], before[:, 0])
    assert not neighbors[:, 2:].any()
    assert not new[~there].any()
    beyond = NEIGHBOR_POSITION_SCALE * new[there, :2] - future[there, -1]
    along = (beyond * direction[there]).sum(dim=1)
    aside = beyond[:, 1] * direction[there, 0] - beyond[:, 0] * direction[there, 1]
    assert (along >= GAP_M[0] - 1e-3).all()
    assert (along <= GAP_M[1] + 1e-3).all()
    assert aside.std().item() == pytest.approx(LATERAL_OFFSET_M, rel=0.2)
    torch.testing.assert_close(new[there, 2:4], direction[there])
    assert (new[there, 4:8] == 0).all()  # it stands


def test_nobody_is_put_beyond_the_reach_or_where_all_places_are_taken() -> None:
    torch.manual_seed(1)
    far = torch.zeros(COUNT, 12, 2)
    far[:, :, 0] = 20.0 * torch.arange(1, 13)
    assert not insert_stopped_vehicles(alone(COUNT), far)["neighbors"][:, 1:].any()
    full = features_in_agent_frame(COUNT)
    assert full["neighbors"].shape[1] == NEIGHBORS
    assert torch.equal(
        insert_stopped_vehicles(full, torch.zeros(COUNT, 12, 2))["neighbors"], full["neighbors"]
    )


def test_who_stands_is_blocked_ahead() -> None:
    torch.manual_seed(2)
    new = insert_stopped_vehicles(alone(COUNT), torch.zeros(COUNT, 12, 2))["neighbors"][:, 1]
    place = NEIGHBOR_POSITION_SCALE * new[new[:, -1] > 0, :2]
    assert (place[:, 0] >= GAP_M[0] - 1e-3).all()
    assert (place.norm(dim=1) < NEIGHBOR_REACH_M).all()
    assert (place[:, 1].abs() < 6 * LATERAL_OFFSET_M).all()
