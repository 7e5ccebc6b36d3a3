"""Donors: which ones fit an agent, their file, and the one that is shipped."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import model
from model.data.explanation_donors import choose_donors
from model.data.scenes import SceneRecord
from model.data.synthetic import SyntheticReader
from model.explanation.donors import (
    FILE,
    Donors,
    DonorsError,
    in_ground_frame,
    in_own_frame,
    load_donors,
    save_donors,
)
from model.explanation.matching import LENGTH_M, LIKE_SPEED, WIDTH_M, is_driveable
from model.scenes.raster import FAR
from tests.model.explanation.made_donors import donors, straight
from tests.model.made_scenes import crowd

SHIPPED = Path(model.__file__).parent / "checkpoints"


def test_donors_are_about_as_fast() -> None:
    found = donors(0.0, 4.2, 5.0, 5.9, 6.2, 30.0).matching(straight(5.0), 0, np.random.default_rng(0))
    assert sorted(found.tolist()) == [1, 2, 3]


def test_there_is_road_under_the_past() -> None:
    made = donors(5.0, 5.0)
    made.far[1, 0, : FAR.rows_behind - 5] = 0  # from 3.6 m behind on
    assert made.matching(straight(5.0), 0, np.random.default_rng(0)).tolist() == [0]
    assert sorted(made.matching(straight(0.9) + 0.0, 0, np.random.default_rng(0)).tolist()) == []
    standing = donors(0.0, 0.0)
    standing.far[1, 0, : FAR.rows_behind - 5] = 0
    assert sorted(standing.matching(straight(0.5), 0, np.random.default_rng(0)).tolist()) == [0, 1]


def test_points_outside_of_a_patch_do_not_count() -> None:
    patch = np.zeros((3, 100, 100), dtype=np.uint8)
    assert is_driveable(patch, FAR, np.array([[-200.0, 0.0], [np.nan, np.nan]]))
    assert not is_driveable(patch, FAR, np.array([[0.0, 0.0]]))


def test_those_with_enough_neighbors_come_first() -> None:
    made = donors(5.0, 5.0, 5.0)
    made.kinds[0, 1:] = 255
    made.kinds[2, 2:] = 255
    assert made.matching(straight(5.0), 3, np.random.default_rng(0)).tolist() == [1, 2, 0]


def test_neighbors_do_not_overlap_with_the_past() -> None:
    made = donors(5.0)
    made.neighbors[0, 0] = straight(5.0, 0.9 * LENGTH_M, 0.9 * WIDTH_M)
    made.neighbors[0, 1] = straight(5.0, 0.9 * LENGTH_M, 1.1 * WIDTH_M)
    kinds, histories = made.neighbors_of(0, 3, straight(5.0))
    assert len(kinds) == len(histories) == 2
    np.testing.assert_array_equal(histories, made.neighbors[0, 1:])
    assert len(made.neighbors_of(0, 1, straight(5.0))[0]) == 1


def test_speeds_are_spread_as_their_weights_are() -> None:
    made = replace(donors(9.0, 1.0, 5.0), weight=np.array([0.5, 0.25, 0.25]))
    assert made.spread(4, None).tolist() == [1, 2, 0, 0]


def test_spread_donors_have_the_agents_road_under_their_past() -> None:
    made = donors(0.1, 9.0)
    patch = np.zeros((3, 100, 100), dtype=np.float32)
    patch[0, FAR.rows_behind - 2 :] = 1
    assert made.spread(2, patch).tolist() == [0, 0]
    assert made.spread(2, np.zeros_like(patch)).tolist() == [0, 1]  # none fits: all count


def test_frames_and_back() -> None:
    scene = crowd()
    agents = np.arange(8)
    position, heading = np.array([3.0, -40.0]), 2.5
    there = in_own_frame(scene.states, agents, position, heading)
    back = in_ground_frame(there, position, heading, 7)
    np.testing.assert_array_equal(back.first, scene.states.first[agents] + 2)
    for name in ("position", "velocity", "acceleration", "heading", "heading_rate"):
        given = getattr(scene.states, name)[agents]
        np.testing.assert_allclose(getattr(back, name)[:, 2:], given, atol=1e-9)
    assert in_ground_frame(there, position, heading, 3).frames == 3


def test_a_file_holds_them(tmp_path: Path) -> None:
    made = donors(0.0, 5.0)
    made.history[0, :2] = np.nan
    save_donors(tmp_path / FILE, made)
    found = load_donors(tmp_path)
    assert found is not None
    np.testing.assert_allclose(found.history, made.history, rtol=1e-3)
    np.testing.assert_array_equal(found.far, made.far)
    assert (found.source, found.license) == ("made up", "none")
    assert load_donors(tmp_path / "elsewhere") is None


def damaged(tmp_path: Path, change: str) -> Path:
    file = tmp_path / FILE
    save_donors(file, donors(1.0, 2.0))
    with np.load(file) as data:
        arrays = dict(data)
    if change == "cut":
        file.write_bytes(file.read_bytes()[:500])
        return tmp_path
    if change == "noise":
        file.write_bytes(b"no archive")
        return tmp_path
    if change == "version":
        arrays["version"] = np.int64(2)
    elif change == "missing":
        del arrays["kinds"]
    elif change == "shape":
        arrays["weight"] = arrays["weight"][:1]
    elif change == "patch":
        arrays["near"] = arrays["near"][:, :-1]
    elif change == "pickle":
        arrays["history"] = np.array([object()], dtype=object)
    elif change == "nan":
        arrays["history"][0, -1] = np.nan
    else:
        arrays["kinds"][0, 0] = 7
    np.savez(file, **arrays)
    return tmp_path


@pytest.mark.parametrize(
    "change", ["cut", "noise", "version", "missing", "shape", "patch", "pickle", "nan", "kind"]
)
def test_a_damaged_file_is_refused(tmp_path: Path, change: str) -> None:
    with pytest.raises(DonorsError, match=FILE):
        load_donors(damaged(tmp_path, change))


@pytest.fixture(scope="module")
def shipped() -> Donors:
    found = load_donors(SHIPPED)
    assert found is not None
    return found


def test_the_shipped_ones(shipped: Donors) -> None:
    assert (SHIPPED / FILE).stat().st_size < 200_000
    assert "non-commercial" in shipped.license
    np.testing.assert_allclose(shipped.weight.sum(), 1.0, atol=1e-5)
    assert np.isfinite(shipped.history).all()
    np.testing.assert_allclose(shipped.history[:, -1, [0, 1, 6]], 0, atol=1e-3)


@pytest.mark.parametrize("speed", [0.0, 3.0, 8.0, 13.0])
def test_usual_speeds_have_enough_shipped_donors(shipped: Donors, speed: float) -> None:
    own = straight(speed)
    found = shipped.matching(own, 2, np.random.default_rng(0))
    assert len(found) >= 4
    assert (np.abs(shipped.speeds[found] - speed) <= LIKE_SPEED).all()


class Few(SyntheticReader):
    """Some made-up scenes."""

    def scenes(self, split: str) -> Iterator[SceneRecord]:
        return islice(super().scenes(split), 5)


def test_donors_are_chosen_from_recorded_scenes() -> None:
    made, again = (choose_donors(Few(Path("3")), "validation", each=1) for _ in range(2))
    np.testing.assert_array_equal(made.history, again.history)
    np.testing.assert_allclose(made.weight.sum(), 1.0)
    speeds = np.rint(made.speeds)
    assert len(np.unique(speeds)) > 3
    assert max(np.bincount(speeds.astype(int))) <= 2  # one with few neighbours, one with many
    assert made.far[:, 0].any(axis=(1, 2)).all()
