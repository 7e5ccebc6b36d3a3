"""Reader of nuScenes through its devkit: on the real mini scenes, and on a data set that is made here."""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from model.data.checks import check_pairs
from model.data.nuscenes import EGO, MARGIN, NuscenesReader
from model.data.nuscenes_pred import NuscenesPredReader
from model.data.scenes import DataError, SceneRecord, Track
from model.geometry import wrap_angle
from model.scenes.scene import AgentType, Raster
from tests.model.data.dataroot import LOCATION, POSES, SAMPLES, SCENE, token, write_dataroot

INSTALLED = find_spec("nuscenes") is not None
needs_devkit = pytest.mark.skipif(not INSTALLED, reason="nuscenes-devkit is not installed")
pytestmark = [
    # Of the devkit's own dependencies
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]


@pytest.fixture(scope="module")
def dataroot(shared: Path) -> Path:
    return shared / "data/nuscenes"


@pytest.fixture(scope="module")
def records(dataroot: Path) -> dict[str, SceneRecord]:
    """Return all mini scenes by name."""
    reader = NuscenesReader(dataroot)
    return {record.name: record for split in ("mini_train", "mini_val") for record in reader.scenes(split)}


@pytest.fixture
def made(tmp_path: Path) -> Path:
    """Return a dataroot of one scene."""
    write_dataroot(tmp_path / "nuscenes")
    return tmp_path / "nuscenes"


@pytest.mark.skipif(INSTALLED, reason="nuscenes-devkit is installed")
def test_without_the_devkit_it_says_what_is_missing(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="needs nuscenes-devkit") as raised:
        NuscenesReader(tmp_path)
    # Never into the environment of the server, whose numpy it would replace
    assert '.venv-nuscenes/bin/pip install "cab-forecast[benchmark]"' in str(raised.value)


@needs_devkit
def test_the_mini_splits(dataroot: Path) -> None:
    reader = NuscenesReader(dataroot)
    for split, scenes, pairs in (("mini_train", 8, 742), ("mini_val", 2, 61)):
        found = list(reader.scenes(split))
        assert len(found) == scenes
        assert sum(len(record.pairs) for record in found) == pairs
        assert [record.name for record in found] == sorted(record.name for record in found)
        for record in found:
            order = [(pair.frame, pair.track) for pair in record.pairs]
            assert order == sorted(order)


@needs_devkit
def test_everybody_is_there(records: dict[str, SceneRecord]) -> None:
    tracks = [one for record in records.values() for one in record.tracks]
    kinds = Counter(one.type for one in tracks)
    assert kinds == {AgentType.VEHICLE: 451, AgentType.PEDESTRIAN: 227, AgentType.CYCLIST: 35}
    still = [np.ptp(one.position, axis=0).max() < 0.5 for one in tracks if one.type is AgentType.VEHICLE]
    assert sum(still) > 200  # parked
    for record in records.values():
        assert len({one.id for one in record.tracks}) == len(record.tracks)
        ego = record.tracks[0]
        assert (ego.id, ego.type) == (EGO, AgentType.VEHICLE)
        np.testing.assert_array_equal(ego.frames, np.arange(len(ego.frames)))
        assert len(ego.frames) >= 39
        for one in record.tracks:
            assert (np.diff(one.frames) > 0).all()
            assert one.frames[-1] < len(ego.frames)
        # It drives the way it looks, and at the speed of a car
        moved = np.diff(ego.position, axis=0)
        fast = np.hypot(*moved.T) > 1.0
        apart = wrap_angle(np.arctan2(moved[:, 1], moved[:, 0]) - ego.heading[:-1])
        assert (np.abs(apart[fast]) < 0.3).all()
        assert np.hypot(*moved.T).max() < 12.0


@needs_devkit
def test_pairs_are_the_official_ones(records: dict[str, SceneRecord], dataroot: Path) -> None:
    official = json.loads((dataroot / "maps/prediction/prediction_scenes.json").read_text())
    for name, record in records.items():
        assert {pair.token for pair in record.pairs} == set(official[name])
        assert all(pair.token.startswith(record.tracks[pair.track].id) for pair in record.pairs)


@needs_devkit
def test_both_readers_agree(records: dict[str, SceneRecord], shared: Path) -> None:
    reader = NuscenesPredReader(shared / "data/nuscenes_pred")
    known = 0
    for split in reader.splits:
        for other in reader.scenes(split):
            if other.name in records:
                known += 1
                _same_tracks_and_pairs(records[other.name], other)
                _same_raster(records[other.name].raster, other.raster)
    assert known == 6


def _same_tracks_and_pairs(record: SceneRecord, other: SceneRecord) -> None:
    where = {
        (*np.round(point, 3).tolist(),): (row, int(frame))
        for row, one in enumerate(record.tracks)
        for frame, point in zip(one.frames, one.position, strict=True)
        if one.type is AgentType.VEHICLE
    }

    def place(one: Track, frame: int) -> tuple[float, ...]:
        return tuple(np.round(one.position[np.searchsorted(one.frames, frame)], 3).tolist())

    def asked(scene: SceneRecord, shift: int) -> set[tuple[int, tuple[float, ...]]]:
        return {(pair.frame + shift, place(scene.tracks[pair.track], pair.frame)) for pair in scene.pairs}

    shifts: Counter[int] = Counter()
    for one in other.tracks:
        for frame, point, heading in zip(one.frames, one.position, one.heading, strict=True):
            row, here = where[(*np.round(point, 3).tolist(),)]  # each of its positions is known
            same = record.tracks[row]
            shifts[here - int(frame)] += 1
            turned = wrap_angle(same.heading[np.searchsorted(same.frames, here)] - heading)
            assert abs(float(turned)) < 1e-9
    # Its frame 0 is the first that is used. (A vehicle that stands still is often in one place.)
    shift = shifts.most_common(1)[0][0]
    assert asked(record, 0) == asked(other, shift)


def _same_raster(raster: Raster, other: Raster) -> None:
    shift = np.round((other.origin - raster.origin) * raster.pixels_per_meter).astype(int)
    sizes = np.array(raster.layers.shape[1:]), np.array(other.layers.shape[1:])
    low, high = np.maximum(shift, 0), np.minimum(sizes[0], shift + sizes[1])
    assert ((high - low) > 400).all()
    ours = raster.layers[:, low[0] : high[0], low[1] : high[1]] > 0
    low, high = low - shift, high - shift
    theirs = other.layers[:, low[0] : high[0], low[1] : high[1]] > 0
    overlap = (ours & theirs).sum(axis=(1, 2)) / np.maximum((ours | theirs).sum(axis=(1, 2)), 1)
    assert overlap[0] > 0.995
    assert (overlap[1:] > 0.95).all()


@needs_devkit
def test_the_raster_reaches_around_everybody(records: dict[str, SceneRecord]) -> None:
    for record in records.values():
        raster = record.raster
        points = np.concatenate([one.position for one in record.tracks])
        pixels = (points - raster.origin) * raster.pixels_per_meter
        room = 3 * MARGIN
        assert (pixels >= room).all()
        assert (pixels <= np.array(raster.layers.shape[1:]) - 1 - room).all()
        # The ego vehicle drives on the road
        row, column = np.round(pixels[: len(record.tracks[0].frames)]).astype(int).T
        assert raster.layers[0, row, column].mean() > 0.95


@needs_devkit
def test_a_scene_in_all_detail(made: Path) -> None:
    (record,) = NuscenesReader(made).scenes("mini_train")
    assert record.name == SCENE
    names = sorted(("car", "parked", "walker", "bicycle", "stroller"), key=token)
    assert [one.id for one in record.tracks] == [EGO, *map(token, names)]
    kinds = {
        "car": AgentType.VEHICLE,
        "parked": AgentType.VEHICLE,
        "walker": AgentType.PEDESTRIAN,
        "bicycle": AgentType.CYCLIST,
        "stroller": AgentType.UNKNOWN,
    }
    for name, one in zip((EGO, *names), record.tracks, strict=True):
        poses = np.array([POSES[name](frame / 2) for frame in range(SAMPLES)])
        np.testing.assert_array_equal(one.frames, np.arange(SAMPLES))
        np.testing.assert_array_equal(one.position, poses[:, :2])
        np.testing.assert_allclose(wrap_angle(one.heading - poses[:, 2]), 0, atol=1e-9)
        assert one.type is kinds.get(name, AgentType.VEHICLE)
    row = 1 + names.index("car")
    assert [(pair.track, pair.frame) for pair in record.pairs] == [(row, 4), (row, 5), (row, 7)]
    assert record.pairs[0].token == f"{token('car')}_{token('sample 4')}"

    raster = record.raster
    assert raster.pixels_per_meter == 3.0

    def layers(x: float, y: float) -> list[int]:
        row, column = np.round((np.array([x, y]) - raster.origin) * 3).astype(int)
        return [int(layer[row, column]) for layer in raster.layers]

    assert layers(450, 698.5) == [1, 0, 0]
    assert layers(450, 700) == [1, 1, 0]
    assert layers(450, 697) == [1, 0, 1]
    assert layers(450, 692) == layers(450, 708) == layers(510, 698.5) == [0, 0, 0]
    assert layers(405, 704) == [0, 0, 0]  # the island
    assert layers(405, 705.6) == [1, 0, 0]


@needs_devkit
def test_standing_vehicles_of_the_mini_scenes(dataroot: Path) -> None:
    reader = NuscenesReader(dataroot)
    names = {}
    for split, pairs in (("mini_train_standing", 341), ("mini_val_standing", 276)):
        found = list(reader.scenes(split))
        names[split] = [record.name for record in found]
        assert names[split] == sorted(names[split])
        assert sum(len(record.pairs) for record in found) == pairs
        moved = []
        for record in found:
            check_pairs(record.name, record.tracks, record.pairs)
            last: dict[int, int] = {}
            for pair in record.pairs:
                one = record.tracks[pair.track]
                assert one.id != EGO
                places = one.positions(pair.frame + np.arange(-4, 13))
                assert np.isfinite(places).all()
                assert np.hypot(*(places[:5] - places[4]).T).max() < 0.3
                assert pair.frame - last.get(pair.track, -4) >= 4
                last[pair.track] = pair.frame
                moved.append(float(np.hypot(*(places[10] - places[4]))))
        # Hardly any moves within 3 s
        assert np.mean(np.array(moved) > 2) < 0.02
    assert len(names["mini_train_standing"]) == 7
    assert names["mini_val_standing"] == ["scene-0103", "scene-0916"]
    assert SCENE not in names["mini_train_standing"]


@needs_devkit
def test_pairs_of_a_standing_vehicle(made: Path) -> None:
    # It is of the challenge's train_val
    assert list(NuscenesReader(made).scenes("mini_train_standing")) == []
    _edit("scene", lambda rows: rows[0].update(name="scene-0655"))(made)
    (record,) = NuscenesReader(made).scenes("mini_train_standing")
    row = [one.id for one in record.tracks].index(token("parked"))
    # Of frames 4 to 7, which have whole pasts and futures, the first: the next one is 2 s later
    assert [(pair.track, pair.frame) for pair in record.pairs] == [(row, 4)]
    assert record.pairs[0].token == f"{token('parked')}_{token('sample 4')}"
    assert list(NuscenesReader(made).scenes("mini_val_standing")) == []


def _edit(table: str, change: Callable[[list[dict[str, object]]], object]) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        file = root / f"v1.0-mini/{table}.json"
        rows = json.loads(file.read_text())
        change(rows)
        file.write_text(json.dumps(rows))

    return apply


MAP, PAIRS = f"maps/expansion/{LOCATION}.json", "maps/prediction/prediction_scenes.json"
NAN_TURN = {"rotation": [0, 0, 0, float("nan")]}


@needs_devkit
@pytest.mark.parametrize(
    ("damage", "file", "fault"),
    [
        (lambda root: shutil.rmtree(root / "v1.0-mini"), "v1.0-mini", "there is no such folder"),
        (lambda root: (root / "v1.0-mini/log.json").unlink(), "v1.0-mini/log.json", "no such file"),
        (lambda root: (root / "v1.0-mini/log.json").write_text("[{"), "v1.0-mini/log.json", "not JSON"),
        (_edit("instance", lambda rows: rows.clear()), "v1.0-mini", "there is no record or field"),
        (_edit("ego_pose", lambda rows: rows[0].update(translation=[1])), "v1.0-mini", ""),
        (
            _edit("sample_annotation", lambda rows: [row.update(NAN_TURN) for row in rows]),
            "v1.0-mini",
            "a pose that is not finite",
        ),
        (_edit("sample_annotation", lambda rows: rows.extend(rows[:])), "v1.0-mini", "annotated twice"),
        (lambda root: (root / MAP).unlink(), MAP, "no such file"),
        (lambda root: (root / MAP).write_text("{"), MAP, "not JSON"),
        (lambda root: (root / MAP).write_text('{"version": "1.0"}'), MAP, "outdated map version"),
        (lambda root: (root / PAIRS).unlink(), PAIRS, "no such file"),
        (lambda root: (root / PAIRS).write_text('{"scene-0061": ["a_b"]}'), PAIRS, "no record or field 'b'"),
    ],
)
def test_bad_files_are_named(made: Path, damage: Callable[[Path], object], file: str, fault: str) -> None:
    damage(made)
    with pytest.raises(DataError) as caught:
        next(NuscenesReader(made).scenes("mini_train"))
    assert str(made / file) in str(caught.value)
    assert fault in str(caught.value)


@needs_devkit
def test_splits_of_data_that_is_not_there(made: Path) -> None:
    reader = NuscenesReader(made)
    challenge = ("mini_train", "mini_val", "train", "train_val", "val")
    assert reader.splits == (*challenge, "mini_train_standing", "mini_val_standing")
    with pytest.raises(DataError, match=r"v1\.0-trainval: there is no such folder"):
        next(reader.scenes("train"))
    with pytest.raises(DataError, match="no split 'test'"):
        next(reader.scenes("test"))
