"""Reader of the nuscenes_pred layout: real data, and files that are made and broken here."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from model.data.nuscenes_pred import NuscenesPredReader
from model.data.protocols import frame_scene
from model.data.scenes import DataError, SceneRecord
from model.forecaster import Protocol
from model.scenes.resample import resample
from model.scenes.scene import AgentType
from service.predict.request import read_agents
from service.settings import Settings
from tests.nuscenes_pred import real_raster, real_request

SCENE = "scene-0007"


def _row(frame: int, agent: int = 3, kind: str = "Car", asked: int = 0) -> list[str]:
    numbers = [1.5, 1.6, 4.2, 100.0 + frame, 1.0, 200.0 + 2 * frame, 0.25]
    return [f"{frame}.0", f"{agent}.0", kind, *["-1.0"] * 7, *map(str, numbers), f"{asked}.0"]


def _write(folder: Path, rows: list[list[str]]) -> None:
    labels, maps = folder / "label/train", folder / "map_0.1"
    labels.mkdir(parents=True, exist_ok=True)
    maps.mkdir(exist_ok=True)
    (labels / f"{SCENE}.txt").write_text("\n".join(" ".join(row) for row in rows) + "\n")
    (maps / f"meta_{SCENE}.txt").write_text("90.00\n180.00\n3.00\n")
    # As cv2 writes [x, y, layer]: the layer 0 is blue, the last channel here
    pixels = np.zeros((60, 40, 3), dtype=np.uint8)
    pixels[50, 5, 2] = pixels[51, 6, 1] = pixels[52, 7, 0] = 255
    Image.fromarray(pixels).save(maps / f"{SCENE}.png")


ROWS = [*(_row(frame, asked=int(frame == 4)) for frame in range(17)), _row(3, agent=1, kind="Bus")]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a whole data set of one scene."""
    _write(tmp_path, ROWS)
    return tmp_path


def _read(folder: Path) -> list[SceneRecord]:
    return list(NuscenesPredReader(folder).scenes("train"))


def test_what_a_scene_holds(folder: Path) -> None:
    (record,) = _read(folder)
    assert record.name == SCENE
    assert [(one.id, one.type, len(one.frames)) for one in record.tracks] == [
        ("1", AgentType.VEHICLE, 1),
        ("3", AgentType.VEHICLE, 17),
    ]
    assert [(pair.track, pair.frame, pair.token) for pair in record.pairs] == [(1, 4, "")]
    long = record.tracks[1]
    np.testing.assert_array_equal(long.frames, np.arange(17))
    np.testing.assert_array_equal(long.position[4], [104.0, 208.0])
    np.testing.assert_array_equal(long.heading, 0.25)
    assert np.argwhere(record.raster.layers).tolist() == [[0, 50, 5], [1, 51, 6], [2, 52, 7]]
    assert record.raster.layers.shape == (3, 60, 40)
    assert record.raster.origin.tolist() == [90.0, 180.0]
    assert record.raster.pixels_per_meter == 3.0


def test_rows_may_come_in_any_order(folder: Path) -> None:
    before = _read(folder)[0]
    _write(folder, ROWS[::-1])
    after = _read(folder)[0]
    assert after.pairs == before.pairs
    for one, other in zip(after.tracks, before.tracks, strict=True):
        np.testing.assert_array_equal(one.position, other.position)


def test_scenes_without_pairs_are_passed_over(folder: Path) -> None:
    _write(folder, [_row(frame) for frame in range(17)])
    assert _read(folder) == []


def _rows(change: Callable[[list[list[str]]], object]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        rows = [list(row) for row in ROWS]
        change(rows)
        _write(folder, rows)

    return apply


def _cell(row: int, column: int, value: str) -> Callable[[Path], None]:
    return _rows(lambda rows: rows[row].__setitem__(column, value))


LABEL, PICTURE, META = f"label/train/{SCENE}.txt", f"map_0.1/{SCENE}.png", f"map_0.1/meta_{SCENE}.txt"


@pytest.mark.parametrize(
    ("damage", "file", "fault"),
    [
        (_rows(lambda rows: rows[2].pop()), LABEL, "row 3 has 17 columns, not 18"),
        (_rows(lambda rows: rows.clear()), LABEL, "it is empty"),
        (_cell(1, 2, "Tank"), LABEL, "row 2 is of the unknown class 'Tank'"),
        (_cell(1, 13, "east"), LABEL, "could not convert string to float: 'east'"),
        (_cell(1, 13, "nan"), LABEL, "row 2 has a number that is not finite"),
        (_cell(1, 16, "inf"), LABEL, "row 2 has a number that is not finite"),
        (_cell(1, 0, "1.5"), LABEL, "row 2 has no proper frame number"),
        (_cell(1, 0, "1e9"), LABEL, "row 2 has no proper frame number"),
        (_cell(1, 0, "-1"), LABEL, "row 2 has no proper frame number"),
        (_cell(1, 1, "3.5"), LABEL, "row 2 has no proper agent id"),
        (_cell(1, 17, "2"), LABEL, "row 2 has a last column that is neither 0 nor 1"),
        (_cell(1, 0, "2"), LABEL, "agent 3 has frame 2 twice"),
        (_cell(0, 17, "1"), LABEL, "agent 3 at frame 0 is a pair but has no history"),
        (_cell(5, 17, "1"), LABEL, "agent 3 at frame 5 is a pair but has no whole future"),
        (_rows(lambda rows: rows.pop(9)), LABEL, "agent 3 at frame 4 is a pair but has no whole future"),
        (lambda folder: (folder / LABEL).write_bytes(b"\xff\xfe"), LABEL, "not a text file"),
        (lambda folder: (folder / PICTURE).unlink(), PICTURE, "there is no such file"),
        (lambda folder: (folder / PICTURE).write_text("hello"), PICTURE, "not a whole image"),
        (
            lambda folder: (folder / PICTURE).write_bytes((folder / PICTURE).read_bytes()[:60]),
            PICTURE,
            "not a whole image",
        ),
        (lambda folder: (folder / META).unlink(), META, "there is no such file"),
        (lambda folder: (folder / META).write_text("1 2"), META, "not an origin"),
        (lambda folder: (folder / META).write_text("1 2 x"), META, "could not convert"),
        (lambda folder: (folder / META).write_text("1 2 0"), META, "not an origin"),
        (lambda folder: (folder / META).write_text("1 nan 3"), META, "not an origin"),
        (lambda folder: (folder / LABEL).unlink(), "label/train", "there are no label files"),
    ],
)
def test_bad_files_are_named(folder: Path, damage: Callable[[Path], object], file: str, fault: str) -> None:
    damage(folder)
    with pytest.raises(DataError) as caught:
        _read(folder)
    assert str(folder / file) in str(caught.value)
    assert fault in str(caught.value)


def test_splits(folder: Path) -> None:
    reader = NuscenesPredReader(folder)
    assert reader.splits == ("train", "train_main", "train_fold", "train_val")
    with pytest.raises(DataError, match="no split 'val'; there are train, train_main, train_fold, train_val"):
        next(reader.scenes("val"))
    with pytest.raises(DataError, match="label/val: there are no label files"):
        next(reader.scenes("train_val"))


def test_train_falls_into_two_parts_by_the_names_of_its_scenes(folder: Path) -> None:
    for number in range(60):
        for file in (LABEL, PICTURE, META):
            copy = folder / file.replace(SCENE, f"scene-{number:04}")
            copy.write_bytes((folder / file).read_bytes())
    reader = NuscenesPredReader(folder)
    train, main, fold = (
        [one.name for one in reader.scenes(f"train{part}")] for part in ("", "_main", "_fold")
    )
    assert len(train) == 60
    assert sorted(main + fold) == train
    assert not set(main) & set(fold)
    assert 2 <= len(fold) <= 12
    # It hangs on the name alone: with other scenes beside it a scene stays where it is
    for name in train[::2]:
        (folder / LABEL.replace(SCENE, name)).unlink()
    assert [one.name for one in reader.scenes("train_fold")] == [one for one in fold if one in train[1::2]]


@pytest.mark.parametrize(("split", "scenes", "pairs"), [("train", 475, 32186), ("train_val", 185, 8560)])
def test_the_real_challenge(shared: Path, split: str, scenes: int, pairs: int) -> None:
    counts = [
        (record.name, len(record.pairs))
        for record in NuscenesPredReader(shared / "data/nuscenes_pred").scenes(split)
    ]
    assert len(counts) == scenes
    assert sum(count for _, count in counts) == pairs
    assert counts == sorted(counts)


def test_training_sees_what_serving_sees(shared: Path) -> None:
    data = shared / "data/nuscenes_pred"
    record = next(NuscenesPredReader(data).scenes("train_val"))
    sent = real_raster(data, record.name)
    raster = record.raster
    assert (sent.rows, sent.columns) == raster.layers.shape[1:]
    assert (sent.origin_x, sent.origin_y, sent.pixels_per_meter) == (*raster.origin, raster.pixels_per_meter)
    assert np.packbits(raster.layers).tobytes() == sent.image.packed_bits
    for frame in sorted({pair.frame for pair in record.pairs}):
        request = real_request(data, "val", record.name, frame)
        agents = read_agents(request, Settings())
        assert agents.observations is not None
        served = resample(agents.observations, request.time, 5)
        scene, tracks = frame_scene(record, frame, Protocol.CAUSAL, 5)
        ids = [str(int(float(agents.ids[index]))) for index in agents.valid.tolist()]
        rows = [ids.index(record.tracks[track].id) for track in tracks.tolist()]
        # Those that serving refuses: seen for the first time
        assert sorted(set(range(len(ids))) - set(rows)) == np.flatnonzero(~served.velocity_known).tolist()
        for name in ("position", "velocity", "acceleration", "heading", "heading_rate", "first"):
            np.testing.assert_allclose(
                getattr(scene.states, name), getattr(served, name)[rows], atol=1e-9, err_msg=name
            )
