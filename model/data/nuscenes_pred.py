"""Reader of the nuScenes prediction challenge in the layout of AgentFormer's preprocessing.

    label/<train|val>/<scene>.txt    a row per vehicle and 2 Hz frame
    map_0.1/<scene>.png              the raster, written by cv2 from [x, y, layer]
    map_0.1/meta_<scene>.txt         x and y of the raster's origin (m), pixels per metre

It holds only the vehicles of the challenge, around their windows: no pedestrians, parked cars or ego vehicle.
"""

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from model.arrays import Floats
from model.data.checks import check_pairs
from model.data.scenes import DataError, Pair, SceneRecord, Track
from model.scenes.scene import AgentType, Raster

_FOLDERS = {"train": "train", "train_main": "train", "train_fold": "train", "train_val": "val"}
"""Folders of the splits. The challenge's train_val is the folder val: AgentFormer evaluates on the
challenge's validation split."""
_FOLD_PARTS = 10
"""One in so many scenes of train is in ``train_fold``, the others are in ``train_main``. Recipes and epochs
are chosen on the fold, so that train_val stays unseen."""
_IN_FOLD = {"train_main": False, "train_fold": True}
_CLASSES = frozenset({"Car", "Bus", "Truck", "Emergency", "Construction"})
_COLUMNS = 18
_FRAME, _AGENT, _CLASS, _X, _Y, _YAW, _IS_PAIR = 0, 1, 2, 13, 15, 16, 17
_MAX_FRAMES = 10_000
"""Maximum frame number; no scene is longer."""
_MAX_PIXELS = 100_000_000


class NuscenesPredReader:
    """The prediction challenge without the data set itself: positions and headings as annotated."""

    def __init__(self, folder: Path) -> None:
        """
        Args:
            folder: folder with ``label`` and ``map_0.1``.
        """
        self._folder = folder

    @property
    def place(self) -> str:
        """The folder, absolute."""
        return str(self._folder.resolve())

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits of the prediction challenge, and train in two parts, by scenes."""
        return tuple(_FOLDERS)

    def scene_count(self, split: str) -> int:
        """Return the number of scenes of a split, see ``Reader``."""
        return len(self._files(split))

    def scenes(self, split: str) -> Iterator[SceneRecord]:
        """Yield the scenes of a split that have pairs, in order of their names.

        Raises:
            DataError: there is no such split, or a file is missing or bad; names it.
        """
        for file in self._files(split):
            record = self._scene(file)
            if record.pairs:
                yield record

    def _files(self, split: str) -> list[Path]:
        """Return the label files of a split's scenes, in order of their names."""
        if split not in _FOLDERS:
            raise DataError(f"there is no split {split!r}; there are {', '.join(_FOLDERS)}")
        folder = self._folder / "label" / _FOLDERS[split]
        files = sorted(folder.glob("*.txt"))
        if not files:
            raise DataError(f"{folder}: there are no label files (*.txt)")
        return [file for file in files if split not in _IN_FOLD or _IN_FOLD[split] is _in_fold(file.stem)]

    def _scene(self, file: Path) -> SceneRecord:
        tracks, pairs = _read_labels(file)
        check_pairs(str(file), tracks, pairs)
        maps = self._folder / "map_0.1"
        raster = _read_raster(maps / f"{file.stem}.png", maps / f"meta_{file.stem}.txt")
        return SceneRecord(file.stem, tracks, pairs, raster)


def _in_fold(scene: str) -> bool:
    """Return whether a scene of train is in the fold; it depends on its name alone."""
    return zlib.crc32(scene.encode()) % _FOLD_PARTS == 0


def _read_labels(file: Path) -> tuple[list[Track], list[Pair]]:
    rows = [line.split() for line in _read_text(file).splitlines() if line.strip()]
    if not rows:
        raise DataError(f"{file}: it is empty")
    for number, row in enumerate(rows, start=1):
        if len(row) != _COLUMNS:
            raise DataError(f"{file}: row {number} has {len(row)} columns, not {_COLUMNS}")
        if row[_CLASS] not in _CLASSES:
            raise DataError(f"{file}: row {number} is of the unknown class {row[_CLASS]!r}")
    columns = [column for column in range(_COLUMNS) if column != _CLASS]
    values = np.full((len(rows), _COLUMNS), np.nan)
    try:
        values[:, columns] = [[float(row[column]) for column in columns] for row in rows]
    except ValueError as error:
        raise DataError(f"{file}: {error}") from error
    _check_values(file, values[:, columns], values)

    order = np.lexsort((values[:, _FRAME], values[:, _AGENT]))
    values = values[order]
    agents, starts = np.unique(values[:, _AGENT], return_index=True)
    tracks, pairs = [], []
    for index, part in enumerate(np.split(values, starts[1:])):
        frames = part[:, _FRAME].astype(np.int64)
        name = str(int(agents[index]))
        twice = frames[1:][np.diff(frames) == 0]
        if twice.size:
            raise DataError(f"{file}: agent {name} has frame {twice[0]} twice")
        position, heading = part[:, [_X, _Y]], part[:, _YAW].copy()
        tracks.append(Track(name, AgentType.VEHICLE, frames, position, heading))
        pairs += [Pair(index, int(frame)) for frame in frames[part[:, _IS_PAIR] == 1]]
    pairs.sort(key=lambda pair: (pair.frame, pair.track))
    return tracks, pairs


def _check_values(file: Path, numbers: Floats, values: Floats) -> None:
    frame, agent, is_pair = values[:, _FRAME], values[:, _AGENT], values[:, _IS_PAIR]
    faults = {
        "a number that is not finite": ~np.isfinite(numbers).all(axis=1),
        "no proper frame number": (frame != np.floor(frame)) | (frame < 0) | (frame >= _MAX_FRAMES),
        "no proper agent id": agent != np.floor(agent),
        "a last column that is neither 0 nor 1": (is_pair != 0) & (is_pair != 1),
    }
    for fault, rows in faults.items():
        bad = np.flatnonzero(rows)
        if bad.size:
            raise DataError(f"{file}: row {bad[0] + 1} has {fault}")


def _read_raster(file: Path, meta: Path) -> Raster:
    try:
        numbers = np.array([float(word) for word in _read_text(meta).split()])
    except ValueError as error:
        raise DataError(f"{meta}: {error}") from error
    if numbers.shape != (3,) or not np.isfinite(numbers).all() or numbers[2] <= 0:
        raise DataError(f"{meta}: not an origin and a positive number of pixels per metre")
    try:
        with Image.open(file) as image:
            if image.width * image.height > _MAX_PIXELS:
                raise DataError(f"{file}: {image.width} × {image.height} pixels are too many")
            # cv2 writes the last axis as blue, green, red; the array's rows run along x
            pixels = np.asarray(image.convert("RGB"))[:, :, ::-1]
    except FileNotFoundError as error:
        raise DataError(f"{file}: there is no such file") from error
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise DataError(f"{file}: not a whole image: {error}") from error
    layers = np.ascontiguousarray(np.moveaxis(pixels >= 128, 2, 0)).astype(np.uint8)
    return Raster(layers, numbers[:2], float(numbers[2]))


def _read_text(file: Path) -> str:
    try:
        return file.read_text(encoding="ascii")
    except FileNotFoundError as error:
        raise DataError(f"{file}: there is no such file") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{file}: not a text file") from error
    except OSError as error:
        raise DataError(f"{file}: cannot be read: {error.strerror}") from error
