"""Made-up drives: the same ones every time, such as cars can drive, on the road, of all kinds."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from model.arrays import Floats
from model.data.checks import FUTURE_STEPS, check_pairs, check_raster
from model.data.scenes import DataError, SceneRecord, Track
from model.data.sources import READERS, parse_data
from model.data.synthetic import HISTORY_STEPS, SCENES, SyntheticReader
from model.geometry import wrap_angle
from model.scenes.scene import AgentType

SAMPLE = 120


@pytest.fixture(scope="module")
def records() -> list[SceneRecord]:
    reader = SyntheticReader(Path("0"))
    return [reader.scene("train", number) for number in range(SAMPLE)]


@pytest.fixture(scope="module")
def vehicles(records: list[SceneRecord]) -> list[tuple[SceneRecord, Track]]:
    return [
        (record, track) for record in records for track in record.tracks if track.type is AgentType.VEHICLE
    ]


def test_a_seed_stands_for_the_data() -> None:
    kind, path = parse_data("synthetic:0")
    readers = [READERS[kind](path), SyntheticReader(Path("0"))]
    first = [next(reader.scenes("validation")) for reader in readers]
    for one, other in zip(first[0].tracks, first[1].tracks, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
        np.testing.assert_array_equal(one.heading, other.heading)
    np.testing.assert_array_equal(first[0].raster.layers, first[1].raster.layers)
    assert first[0].pairs == first[1].pairs
    assert readers[0].place == readers[1].place
    # Each scene by itself, whatever was made before
    again, scenes = SyntheticReader(Path("0")), readers[0].scenes("train")
    next(scenes)
    np.testing.assert_array_equal(next(scenes).tracks[0].position, again.scene("train", 1).tracks[0].position)


def test_other_seeds_splits_and_numbers_are_other_data() -> None:
    scenes = [
        SyntheticReader(Path(seed)).scene(split, number)
        for seed, split, number in (
            ("0", "train", 0),
            ("1", "train", 0),
            ("0", "validation", 0),
            ("0", "train", 1),
        )
    ]
    starts = {tuple(scene.tracks[0].position[0]) for scene in scenes}
    assert len(starts) == len(scenes)
    assert SyntheticReader(Path("0")).place != SyntheticReader(Path("1")).place


def test_splits() -> None:
    reader = SyntheticReader(Path("7"))
    assert reader.splits == ("train", "validation", "hard")
    names = [scene.name for scene in reader.scenes("validation")]
    assert names == sorted(names)
    assert len(set(names)) == SCENES["validation"] == 60
    assert SCENES["train"] == 1000
    with pytest.raises(DataError, match="no split 'val'; there are train, validation"):
        reader.scenes("val")


@pytest.mark.parametrize("seed", ["-1", "one", "1.5", "a/0", "²"])
def test_what_is_no_seed_is_said(seed: str) -> None:
    with pytest.raises(DataError, match=f"synthetic:{seed}: the seed is not"):
        READERS["synthetic"](Path(seed))


def test_they_are_what_training_takes(records: list[SceneRecord]) -> None:
    for record in records:
        check_pairs(record.name, record.tracks, record.pairs)
        check_raster(record.name, record.raster)
        order = [(pair.frame, pair.track) for pair in record.pairs]
        assert order == sorted(set(order))
        for pair in record.pairs:
            frames = record.tracks[pair.track].frames
            assert frames[0] <= pair.frame - HISTORY_STEPS
            assert frames[-1] >= pair.frame + FUTURE_STEPS
    # 8000 in all the train scenes
    assert sum(len(record.pairs) for record in records) > 8 * SAMPLE


def _steps(track: Track) -> tuple[Floats, Floats, Floats]:
    """Return speed [F - 1], m/s, signed by the heading halfway, course relative to that, and turn, rad."""
    moved = np.diff(track.position, axis=0)
    turn = wrap_angle(np.diff(track.heading))
    slip = wrap_angle(np.arctan2(moved[:, 1], moved[:, 0]) - track.heading[:-1] - turn / 2)
    return np.hypot(*moved.T) * 2 * np.sign(np.cos(slip)), slip, turn


def test_cars_can_drive_so(vehicles: list[tuple[SceneRecord, Track]]) -> None:
    backwards = 0
    for record, track in vehicles:
        speed, slip, turn = _steps(track)
        where = f"{record.name}, {track.id}"
        assert np.abs(speed).max() <= 41, where
        assert np.abs(np.diff(speed)).max() * 2 <= 5, where
        moves = np.abs(speed) > 0.5
        # Forwards all the time or backwards all the time
        assert (speed[moves] > 0).all() or (speed[moves] < 0).all(), where
        assert (np.abs(np.sin(slip[moves])) < 0.15).all(), where
        assert (np.abs(turn[moves]) <= 0.25 * np.abs(speed[moves]) / 2).all(), where
        backwards += bool(moves.any() and (speed[moves] < 0).all())
        if backwards and (speed[moves] < 0).any():
            assert speed.min() > -3.6, where
    assert backwards > 10


def test_they_stay_on_the_road(vehicles: list[tuple[SceneRecord, Track]]) -> None:
    for record, track in vehicles:
        raster = record.raster
        pixels = np.round((track.position - raster.origin) * raster.pixels_per_meter).astype(int)
        assert raster.layers[0][tuple(pixels.T)].all(), f"{record.name}, {track.id}"


def test_the_map_goes_on_beyond_the_tracks(records: list[SceneRecord]) -> None:
    for record in records:
        raster = record.raster
        assert raster.pixels_per_meter == 3.0
        assert set(np.unique(raster.layers)) <= {0, 1}
        everywhere = np.concatenate([track.position for track in record.tracks])
        far = raster.origin + np.array(raster.layers.shape[1:]) / raster.pixels_per_meter
        assert (everywhere.min(axis=0) - raster.origin >= 75).all()
        assert (far - everywhere.max(axis=0) >= 75).all()
        assert (raster.origin > 0).all()
        # So does the road: 70 m ahead of whoever moves, something of it is within 60 m to the sides
        for track in record.tracks:
            if track.type is AgentType.VEHICLE and np.hypot(*(track.position[-1] - track.position[0])) > 20:
                ahead = track.position[-1] + 70 * np.array(
                    [np.cos(track.heading[-1]), np.sin(track.heading[-1])]
                )
                row, column = ((ahead - raster.origin) * 3).astype(int)
                seen = raster.layers[0][max(row - 180, 0) : row + 180, max(column - 180, 0) : column + 180]
                assert seen.any(), f"{record.name}, {track.id}"


def test_all_kinds_are_there(records: list[SceneRecord]) -> None:
    kinds: Counter[str] = Counter()
    starts = 0
    for record in records:
        for pair in record.pairs:
            track = record.tracks[pair.track]
            speed, _, _ = _steps(track)
            past = track.position[pair.frame] - track.position[pair.frame - 4]
            soon = track.position[pair.frame + 6] - track.position[pair.frame]
            around = np.unwrap(track.heading)[pair.frame - 2 : pair.frame + FUTURE_STEPS + 1]
            if np.hypot(*past) < 0.3:
                kinds["standing"] += 1
                starts += bool(np.hypot(*soon) > 2)
            elif speed[pair.frame - 1] < 0:
                kinds["reversing"] += 1
            elif speed[pair.frame - 1] < 2.3:
                kinds["slow"] += 1
            elif speed[pair.frame - 1] > 20:
                kinds["fast"] += 1
            else:
                kinds["turning" if np.ptp(around) > 0.35 else "other"] += 1
    shares = {kind: number / kinds.total() for kind, number in kinds.items()}
    assert 0.18 < shares["standing"] < 0.33
    assert 0.015 < shares["reversing"] < 0.09
    assert 0.04 < shares["slow"] < 0.15
    assert 0.08 < shares["fast"] < 0.22
    assert 0.17 < shares["turning"] < 0.35
    # Most of those that stand go on standing, and some do not
    assert 0.01 < starts / kinds["standing"] < 0.15


def test_those_that_stand_stand(vehicles: list[tuple[SceneRecord, Track]]) -> None:
    still = [track for _, track in vehicles if np.ptp(track.position, axis=0).max() < 0.3]
    assert len(still) > len(vehicles) / 5
    for track in still:
        np.testing.assert_allclose(track.heading, track.heading[0], atol=0.05)


def test_traffic_on_either_side(records: list[SceneRecord]) -> None:
    sides: Counter[str] = Counter()
    for record in records:
        # The road divider lies left of who drives on the right
        raster = record.raster
        for track in record.tracks:
            speed, _, turn = _steps(track)
            if track.type is AgentType.PEDESTRIAN or speed.min() < 5 or np.abs(turn).max() > 0.02:
                continue
            beside = np.arange(1.0, 6.0, 1 / 3)
            normal = np.array([-np.sin(track.heading[0]), np.cos(track.heading[0])])
            found = {}
            for name, sign in (("left", 1), ("right", -1)):
                points = track.position[0] + sign * beside[:, None] * normal
                pixels = np.round((points - raster.origin) * 3).astype(int)
                found[name] = bool(raster.layers[1][tuple(pixels.T)].any())
            if found["left"] != found["right"]:
                sides["right" if found["left"] else "left"] += 1
                break
    assert sides["left"] > SAMPLE / 12
    assert sides["right"] > SAMPLE / 12


def test_every_direction(vehicles: list[tuple[SceneRecord, Track]]) -> None:
    headings = np.array([track.heading[0] for _, track in vehicles])
    counts, _ = np.histogram(headings, bins=8, range=(-np.pi, np.pi))
    assert counts.min() > len(vehicles) / 40


def test_pedestrians_walk_and_stand(records: list[SceneRecord]) -> None:
    paces = [
        np.hypot(*np.diff(track.position, axis=0).T).mean() * 2
        for record in records
        for track in record.tracks
        if track.type is AgentType.PEDESTRIAN
    ]
    assert len(paces) > SAMPLE / 2
    assert max(paces) < 3
    assert min(paces) == 0
