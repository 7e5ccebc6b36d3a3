"""Reader of nuScenes itself, through nuscenes-devkit.

The devkit needs numpy < 2 and many other packages, so it is imported only when a reader is made.
"""

import json
import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from model.arrays import Floats
from model.data.checks import FUTURE_STEPS, check_pairs
from model.data.nuscenes_map import VectorMap
from model.data.scenes import DataError, Pair, SceneRecord, Track
from model.scenes.scene import AgentType, Raster

EGO = "ego"
"""Id of the recording car's track."""
MARGIN = 50.0
"""m of map around the tracks of a scene; a patch reaches 34.3 m."""

_ADVICE = (
    "It needs numpy < 2, so give it an environment of its own, and leave the server's as it is: "
    'python3 -m venv .venv-nuscenes && .venv-nuscenes/bin/pip install "cab-forecast[benchmark]"'
)
_VERSIONS = {
    "mini_train": "v1.0-mini",
    "mini_val": "v1.0-mini",
    "train": "v1.0-trainval",
    "train_val": "v1.0-trainval",
    "val": "v1.0-trainval",
    "mini_train_standing": "v1.0-mini",
    "mini_val_standing": "v1.0-mini",
}
_STANDING = {"mini_train_standing": "mini_train", "mini_val_standing": "mini_val"}
"""Splits of standing vehicles, and the official splits whose scenes they use."""
_HELD_BACK = frozenset({"scene-0061"})
"""Scenes of mini_train that are also in the challenge's train_val, and so must not be trained on."""
_STANDING_STEPS = 4
"""Frames before the present in which a standing vehicle does not move (2 s), and between two of its pairs."""
_STANDING_METERS = 0.3
"""m, maximum apparent movement of a standing vehicle, given the annotations' accuracy."""
_CATEGORIES = {
    "vehicle.bicycle": AgentType.CYCLIST,
    "vehicle.motorcycle": AgentType.CYCLIST,
    "vehicle.": AgentType.VEHICLE,
    "human.pedestrian.stroller": AgentType.UNKNOWN,
    "human.pedestrian.wheelchair": AgentType.UNKNOWN,
    "human.pedestrian.": AgentType.PEDESTRIAN,
    "animal": AgentType.UNKNOWN,
}
"""Agent types by prefixes of the category; the first that fits counts. Agents that move like no other type
are UNKNOWN; objects that do not move by themselves (barriers, cones, debris, racks) are left out."""


class NuscenesReader:
    """The data set with all its agents, including parked vehicles, pedestrians, cyclists and the ego vehicle.

    Frames are the numbers of a scene's samples, nominally 0.5 s apart; tracks have instance tokens.
    """

    def __init__(self, dataroot: Path) -> None:
        """
        Args:
            dataroot: folder with ``v1.0-mini`` or ``v1.0-trainval``, and ``maps`` with the map expansion 1.3.

        Raises:
            DataError: nuscenes-devkit is not installed.
        """
        try:
            self._nuscenes = import_module("nuscenes.nuscenes").NuScenes
            self._map_api = import_module("nuscenes.map_expansion.map_api").NuScenesMap
            self._helper = import_module("nuscenes.prediction").PredictHelper
            self._challenge = import_module("nuscenes.eval.prediction.splits").get_prediction_challenge_split
            self._official = import_module("nuscenes.utils.splits").create_splits_scenes
        except ImportError as error:
            raise DataError(f"reading nuScenes needs nuscenes-devkit: {error}. {_ADVICE}") from error
        self._dataroot = dataroot
        self._databases: dict[str, Any] = {}
        self._maps: dict[str, VectorMap] = {}

    @property
    def place(self) -> str:
        """The dataroot, absolute."""
        return str(self._dataroot.resolve())

    @property
    def splits(self) -> tuple[str, ...]:
        """Splits of the prediction challenge, two of them on v1.0-mini, and splits of standing vehicles.

        The latter have only vehicles (not the ego vehicle) that stood for 2 s and whose next 6 s are
        annotated, at frames 2 s apart, moving later or not; the challenge has hardly any that stay.
        ``mini_train_standing`` leaves out scene-0061, which is also in the challenge's train_val.
        """
        return tuple(_VERSIONS)

    def scenes(self, split: str) -> Iterator[SceneRecord]:
        """Yield the scenes of a split that have pairs, in order of their names.

        Raises:
            DataError: there is no such split, or a file is missing or bad; names it.
        """
        database = self._database_of(split)
        with _naming(database.table_root):
            helper = self._helper(database)
        for scene, listed in self._split(database, split):
            record = self._record(database, helper, scene, listed)
            if record.pairs:
                yield record

    def scene_count(self, split: str) -> int:
        """Return the number of scenes of a split, see ``Reader``."""
        return len(self._split(self._database_of(split), split))

    def _split(self, database: Any, split: str) -> list[tuple[dict[str, Any], list[tuple[str, str]] | None]]:
        """Return a split's scenes in order of their names, and their listed pairs; None: standing ones."""
        scenes = sorted(database.scene, key=lambda scene: str(scene["name"]))
        if split in _STANDING:
            names = {*self._official()[_STANDING[split]]} - _HELD_BACK
            return [(scene, None) for scene in scenes if scene["name"] in names]
        listed = self._listed(database, split)
        return [(scene, listed[scene["token"]]) for scene in scenes if scene["token"] in listed]

    def _database_of(self, split: str) -> Any:
        if split not in _VERSIONS:
            raise DataError(f"there is no split {split!r}; there are {', '.join(_VERSIONS)}")
        return self._database(_VERSIONS[split])

    def _database(self, version: str) -> Any:
        if version not in self._databases:
            folder = self._dataroot / version
            if not folder.is_dir():
                raise DataError(f"{folder}: there is no such folder")
            with _naming(folder):
                self._databases[version] = self._nuscenes(version, str(self._dataroot), verbose=False)
        return self._databases[version]

    def _listed(self, database: Any, split: str) -> dict[str, list[tuple[str, str]]]:
        """Return instance and sample tokens of a split's pairs, by the token of their scene."""
        file = self._dataroot / "maps" / "prediction" / "prediction_scenes.json"
        with _naming(file), warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # the devkit leaves the file open
            tokens = self._challenge(split, str(self._dataroot))
            listed: dict[str, list[tuple[str, str]]] = defaultdict(list)
            for token in tokens:
                instance, sample = token.split("_")
                listed[database.get("sample", sample)["scene_token"]].append((instance, sample))
        return listed

    def _record(
        self,
        database: Any,
        helper: Any,
        scene: dict[str, Any],
        listed: Sequence[tuple[str, str]] | None = None,
    ) -> SceneRecord:
        """Return a scene with the listed pairs (instance and sample tokens); None: standing vehicles."""
        where = f"{database.table_root}: {scene['name']}"
        with _naming(where):
            samples = list(_samples(database, scene))
            tracks = _tracks(database, samples)
            location = helper.get_map_name_from_sample_token(scene["first_sample_token"])
            rows = {track.id: row for row, track in enumerate(tracks)}
            frames = {sample["token"]: frame for frame, sample in enumerate(samples)}
            if listed is None:
                listed = [
                    (track.id, samples[frame]["token"])
                    for track in tracks
                    for frame in _standing_frames(track)
                ]
            pairs = [
                Pair(rows[instance], frames[sample], f"{instance}_{sample}") for instance, sample in listed
            ]
        for track in tracks:
            if not (np.isfinite(track.position).all() and np.isfinite(track.heading).all()):
                raise DataError(f"{where}: agent {track.id} has a pose that is not finite")
        pairs.sort(key=lambda pair: (pair.frame, pair.track))
        check_pairs(where, tracks, pairs)
        return SceneRecord(scene["name"], tracks, pairs, self._raster(location, tracks))

    def _raster(self, location: str, tracks: Sequence[Track]) -> Raster:
        if location not in self._maps:
            file = self._dataroot / "maps" / "expansion" / f"{location}.json"
            with _naming(file):
                self._maps[location] = VectorMap(self._map_api(str(self._dataroot), location))
        low = np.min([track.position.min(axis=0) for track in tracks], axis=0)
        high = np.max([track.position.max(axis=0) for track in tracks], axis=0)
        return self._maps[location].raster(low - MARGIN, high + MARGIN)


def _samples(database: Any, scene: dict[str, Any]) -> Iterator[dict[str, Any]]:
    token = scene["first_sample_token"]
    for _ in range(scene["nbr_samples"]):
        sample = database.get("sample", token)
        yield sample
        token = sample["next"]


def _tracks(database: Any, samples: Sequence[dict[str, Any]]) -> list[Track]:
    """Return the track of the ego vehicle, then those of the agents in order of their instance tokens."""
    frames: dict[str, list[int]] = defaultdict(list)
    poses: dict[str, list[list[float]]] = defaultdict(list)
    types: dict[str, AgentType] = {EGO: AgentType.VEHICLE}

    def add(name: str, frame: int, pose: dict[str, Any]) -> None:
        if frames[name][-1:] == [frame]:
            raise DataError(f"agent {name} is annotated twice in frame {frame}")
        frames[name].append(frame)
        poses[name].append([*pose["translation"][:2], *pose["rotation"]])

    for frame, sample in enumerate(samples):
        lidar = database.get("sample_data", sample["data"]["LIDAR_TOP"])
        add(EGO, frame, database.get("ego_pose", lidar["ego_pose_token"]))
        for token in sample["anns"]:
            annotation = database.get("sample_annotation", token)
            kind = _agent_type(annotation["category_name"])
            if kind is not None:
                types[annotation["instance_token"]] = kind
                add(annotation["instance_token"], frame, annotation)

    def track(name: str) -> Track:
        pose = np.array(poses[name], dtype=np.float64)
        number = np.array(frames[name], dtype=np.int64)
        return Track(name, types[name], number, pose[:, :2].copy(), _yaw(pose[:, 2:]))

    return [track(name) for name in (EGO, *sorted(types.keys() - {EGO}))]


def _standing_frames(track: Track) -> list[int]:
    """Return frames at which a vehicle, not the ego, has stood for 2 s and its next 6 s are known."""
    chosen: list[int] = []
    if track.type is not AgentType.VEHICLE or track.id == EGO:
        return chosen
    around = np.arange(-_STANDING_STEPS, FUTURE_STEPS + 1)
    for frame in track.frames.tolist():
        if chosen and frame < chosen[-1] + _STANDING_STEPS:
            continue
        places = track.positions(frame + around)
        past = places[: _STANDING_STEPS + 1] - places[_STANDING_STEPS]
        if np.isfinite(places).all() and np.hypot(*past.T).max() < _STANDING_METERS:
            chosen.append(frame)
    return chosen


def _agent_type(category: str) -> AgentType | None:
    return next((kind for start, kind in _CATEGORIES.items() if category.startswith(start)), None)


def _yaw(quaternion: Floats) -> Floats:
    """Return the direction of the rotated x axis, seen from above: [F, 4] (w, x, y, z) → [F], rad."""
    w, x, y, z = quaternion.T
    yaw: Floats = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return yaw


@contextmanager
def _naming(where: Path | str) -> Iterator[None]:
    """Convert exceptions of the devkit and its tables into ``DataError`` that names a file."""
    try:
        yield
    except DataError as error:
        raise DataError(f"{where}: {error}") from error
    except json.JSONDecodeError as error:
        raise DataError(f"{_broken(where)}: not JSON: {error}") from error
    except FileNotFoundError as error:
        raise DataError(f"{error.filename}: there is no such file") from error
    except OSError as error:
        raise DataError(f"{error.filename or where}: cannot be read: {error.strerror}") from error
    except KeyError as error:
        raise DataError(f"{where}: there is no record or field {error}") from error
    except Exception as error:
        raise DataError(f"{where}: {error}") from error


def _broken(where: Path | str) -> Path | str:
    """Return the first file of a folder that is not JSON."""
    for file in sorted(Path(where).glob("*.json")):
        try:
            json.loads(file.read_bytes())
        except ValueError:
            return file
    return where
