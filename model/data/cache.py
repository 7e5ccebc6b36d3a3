"""All pairs of a split as memory-mapped arrays: what a training step needs, but for the map patches.

A cache is a folder: a ``.npy`` file per array, ``rasters.u8`` and ``manifest.json``. It is written beside
its place and moved there when it is whole.
"""

import json
import shutil
import uuid
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from model.arrays import Bytes, Float32s, Floats, Ints
from model.data.cache_layout import (
    FILE_NAMES,
    FORMAT_VERSION,
    MANIFEST_FILE,
    RASTERS_FILE,
    SCENE_LAYOUT,
    CacheKey,
    Layout,
    Manifest,
    neighbors_name,
    pair_layout,
)
from model.data.checks import FUTURE_STEPS, check_pairs, check_raster
from model.data.packing import pack, pack_patches, unpack
from model.data.protocols import SceneFrames
from model.data.scenes import DataError, Reader, SceneRecord
from model.data.sensing import SensedFrames
from model.features.agent_features import HISTORY_SCALE, agent_frame_features
from model.features.scene_features import network_features
from model.features.spec import Frame
from model.features.standardization import state_scale
from model.forecaster import Context, Protocol
from model.geometry import wrap_angle
from model.networks.config import AnyNetworkConfig, NetworkConfig
from model.scenes.raster import FAR, NEAR, cut_patches
from model.scenes.scene import AgentType, Raster

__all__ = ["Cache", "CacheKey", "build_cache"]

Array: TypeAlias = NDArray[Any]
Arrays: TypeAlias = dict[str, Array]


_GROUND_SCALE = state_scale(AgentType.VEHICLE, AgentType.VEHICLE)


@dataclass(frozen=True)
class Cache:
    """P pairs, ordered by scene, frame, track; S scenes. Arrays are memory-mapped, copy on write."""

    manifest: Manifest
    history: Float32s
    """[P, F, 8], standardised own states (``model.features.scene_features``)."""
    first: Ints
    """[P], the first observed frame of the history."""
    velocity: Float32s
    """[P, 2], now, m/s, ground frame."""
    neighbors: dict[AgentType, Float32s]
    """[P, F, D] per type, summed standardised histories of neighbours."""
    edge_mask: Float32s
    """[P]; zeros where no neighbours' histories are looked at."""
    future: Float32s
    """[P, 12, 2], m, relative to the position now, ground frame."""
    position: Floats
    """[P, 2], now, m, ground frame."""
    heading: Floats
    """[P], now, rad."""
    turn: Float32s
    """[P], rad: how far the heading turns, in all, from the first frame of history to the last of the
    future; left and right cancel out."""
    scene: Ints
    """[P], index into ``manifest.scenes``."""
    track: Ints
    """[P], index into the scene's tracks."""
    frame: Ints
    """[P], number of the 2 Hz frame now."""
    token: NDArray[np.bytes_]
    """[P], "instance_sample", ASCII; empty where the data has no tokens."""
    rasters: Bytes
    """Flat; see ``model.data.packing``."""
    raster_start: Ints
    """[S], where each scene's raster starts."""
    raster_shape: Ints
    """[S, 2], rows and columns, without the border."""
    raster_origin: Floats
    """[S, 2], m."""
    raster_pixels_per_meter: Floats
    """[S]."""
    neighbor_boxes: Float32s | None = None
    """[P, B, 5], neighbours as boxes (``model.features.neighbor_boxes``); None: not held."""
    speed: Float32s | None = None
    """[P], m/s along the heading now; this and what follows is held in the agents' frame only."""
    agents: Float32s | None = None
    """[P, M, 11], neighbours one by one (``model.features.agent_features``)."""
    near_patch: Bytes | None = None
    """[P, 100, 100], map patches of three layers a byte (``model.data.packing``)."""
    far_patch: Bytes | None = None
    """Likewise, of the far patches."""

    def __len__(self) -> int:
        """P."""
        return self.manifest.pairs

    def observed_positions(self) -> Floats:
        """Return where agents were: [P, F, 2], m, relative to now, in the frame of the histories; NaN where
        they were not observed."""
        scale = HISTORY_SCALE if self.manifest.key.agent_frame else _GROUND_SCALE
        positions = np.array(self.history[..., :2]) * scale[:2]
        seen = np.arange(positions.shape[1]) >= self.first[:, None]
        return np.where(seen[..., None], positions, np.nan)

    def raster(self, scene: int) -> Raster:
        """The raster of a scene, as the reader gave it.

        Args:
            scene: index into ``manifest.scenes``.
        """
        rows, columns = map(int, self.raster_shape[scene])
        start = int(self.raster_start[scene])
        packed = self.rasters[start : start + (rows + 2) * (columns + 2)]
        return Raster(
            unpack(packed, rows, columns),
            np.array(self.raster_origin[scene]),
            float(self.raster_pixels_per_meter[scene]),
        )

    @classmethod
    def open(cls, folder: Path, key: CacheKey | None = None) -> "Cache":
        """Opens what ``build_cache`` wrote.

        Args:
            folder: the cache.
            key: what it has to be of; None: anything.

        Raises:
            DataError: it is missing, damaged, stale, or of something else; says what differs.
        """
        manifest = _read_manifest(folder / MANIFEST_FILE)
        if key is not None:
            _check_key(folder, manifest.key, key)
        arrays = _open_arrays(folder, manifest.pairs, pair_layout(manifest.key))
        kinds = manifest.key.summed_types
        neighbors = {kind: arrays.pop(neighbors_name(kind)) for kind in kinds}
        arrays |= _open_arrays(folder, len(manifest.scenes), SCENE_LAYOUT)
        rasters = _open_rasters(folder / RASTERS_FILE, manifest.raster_bytes)
        return cls(manifest=manifest, neighbors=neighbors, rasters=rasters, **arrays)


def build_cache(
    reader: Reader,
    split: str,
    protocol: Protocol,
    config: AnyNetworkConfig,
    history_frames: int,
    folder: Path,
    progress: Callable[[SceneRecord], None] | None = None,
    variants: int = 0,
) -> None:
    """Writes the cache of a split; one that is there already is replaced once the new one is whole.

    Args:
        reader: gives the scenes.
        split: one of the reader's.
        protocol: of the inputs.
        config: says which neighbours are looked at, and how.
        history_frames: F, frames of history, now included.
        folder: where to; made, with its parents, where it does not exist.
        progress: called after each scene.
        variants: V, noisy reports of each pair beside the recorded states (agent frame only).

    Raises:
        DataError: the data is bad, there are no pairs, or the folder holds something else.
    """
    if folder.exists() and not (folder / MANIFEST_FILE).is_file():
        raise DataError(f"{folder}: is there already and is no cache; it is left alone")
    key = CacheKey.of(reader, split, protocol, config, history_frames, variants)
    # Patches are cut from the rasters: in each batch, or in the agent's frame those of all variants at once
    config = config.model_copy(update={"uses_map": False})
    with _replacing(folder) as new:
        pairs: list[Arrays] = []
        scenes: list[Arrays] = []
        names: list[str] = []
        written = 0
        with (new / RASTERS_FILE).open("wb") as rasters:
            for record in reader.scenes(split):
                check_pairs(record.name, record.tracks, record.pairs)
                check_raster(record.name, record.raster)
                make = _agent_frame_arrays if key.agent_frame else _pair_arrays
                pairs.append(make(record, len(names), protocol, config, history_frames, variants))
                scenes.append(_scene_arrays(record.raster, written))
                names.append(record.name)
                written += rasters.write(pack(record.raster).data)
                if progress is not None:
                    progress(record)
        if not pairs:
            raise DataError(f"the split {split!r} has no pairs")
        _save(new, pairs, pair_layout(key))
        _save(new, scenes, SCENE_LAYOUT)
        manifest = Manifest(
            format_version=FORMAT_VERSION,
            key=key,
            pairs=sum(len(part["frame"]) for part in pairs),
            scenes=tuple(names),
            raster_bytes=written,
        )
        (new / MANIFEST_FILE).write_text(manifest.model_dump_json(indent=2) + "\n", encoding="utf-8")


def _agent_frame_arrays(
    record: SceneRecord,
    scene: int,
    protocol: Protocol,
    config: AnyNetworkConfig,
    history_frames: int,
    variants: int,
) -> Arrays:
    """Return the rows of a scene's pairs in the agents' frames, those of a pair one behind the other."""
    network = NetworkConfig(frame=Frame.AGENT, uses_map=False)
    recorded = SceneFrames(record, protocol, history_frames)
    sensed = SensedFrames(record, history_frames, seed=zlib.crc32(record.name.encode()))
    frame = np.array([pair.frame for pair in record.pairs], dtype=np.int64)
    track = np.array([pair.track for pair in record.pairs], dtype=np.int64)
    rows = 1 + variants
    parts: list[Arrays] = []
    for now in np.unique(frame):  # the pairs are in this order
        reports = []
        for variant in range(rows):
            seen, tracks = sensed.at(int(now), variant) if variant else recorded.at(int(now))
            targets = np.searchsorted(tracks, track[frame == now])
            report = agent_frame_features(seen, targets, network.features, Context.FULL)
            reports.append({name: tensor.numpy() for name, tensor in report.items()})
        part: Arrays = {  # [pairs · rows, …]
            name: np.stack([one[name] for one in reports], axis=1).reshape(-1, *reports[0][name].shape[1:])
            for name in reports[0]
        }
        part["position"], part["agents"] = part.pop("origin"), part.pop("neighbors")
        for name, geometry in (("near_patch", NEAR), ("far_patch", FAR)):
            patches = cut_patches(record.raster, part["position"], part["heading"], geometry, outside=0.5)
            part[name] = pack_patches(patches)
        parts.append(part)
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    future, turn = _paths(record, history_frames)
    begun = np.array([record.tracks[pair.track].positions(np.array(pair.frame)) for pair in record.pairs])
    arrays["future"] = np.repeat(future + begun[:, None], rows, axis=0) - arrays["position"][:, None]
    of_pairs = {
        "turn": turn,
        "scene": np.full(len(frame), scene),
        "track": track,
        "frame": frame,
        "token": np.array([pair.token.encode("ascii") for pair in record.pairs], dtype=np.bytes_),
    }
    arrays |= {name: np.repeat(values, rows, axis=0) for name, values in of_pairs.items()}
    count = len(arrays["position"])
    return arrays | {"velocity": np.zeros((count, 2)), "edge_mask": np.zeros(count)}


def _pair_arrays(
    record: SceneRecord,
    scene: int,
    protocol: Protocol,
    config: AnyNetworkConfig,
    history_frames: int,
    variants: int,
) -> Arrays:
    scenes = SceneFrames(record, protocol, history_frames)
    frame = np.array([pair.frame for pair in record.pairs], dtype=np.int64)
    track = np.array([pair.track for pair in record.pairs], dtype=np.int64)
    parts: list[Arrays] = []
    for now in np.unique(frame):  # the pairs are in this order
        seen, tracks = scenes.at(int(now))
        targets = np.searchsorted(tracks, track[frame == now])
        features = network_features(seen, targets, AgentType.VEHICLE, config.features, Context.FULL)
        part: Arrays = {name: tensor.numpy() for name, tensor in features.items()}
        part["position"] = part.pop("origin")
        part["heading"] = seen.states.heading[targets, -1]
        part.setdefault("edge_mask", np.zeros(len(targets)))
        parts.append(part)
    future, turn = _paths(record, history_frames)
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return arrays | {
        "future": future,
        "turn": turn,
        "scene": np.full(len(frame), scene),
        "track": track,
        "frame": frame,
        "token": np.array([pair.token.encode("ascii") for pair in record.pairs], dtype=np.bytes_),
    }


def _paths(record: SceneRecord, history_frames: int) -> tuple[Floats, Floats]:
    """The pairs' future [P, 12, 2], m, and turn [P], rad."""
    future = np.empty((len(record.pairs), FUTURE_STEPS, 2))
    turn = np.empty(len(record.pairs))
    for row, pair in enumerate(record.pairs):
        track = record.tracks[pair.track]
        now = int(np.searchsorted(track.frames, pair.frame))
        start = int(np.searchsorted(track.frames, pair.frame - history_frames + 1))
        end = now + FUTURE_STEPS + 1
        future[row] = track.position[now + 1 : end] - track.position[now]
        turn[row] = abs(wrap_angle(np.diff(track.heading[start:end])).sum())
    return future, turn


def _scene_arrays(raster: Raster, start: int) -> Arrays:
    return {
        "raster_start": np.array([start]),
        "raster_shape": np.array([raster.layers.shape[1:]]),
        "raster_origin": raster.origin[None],
        "raster_pixels_per_meter": np.array([raster.pixels_per_meter]),
    }


def _save(folder: Path, parts: list[Arrays], layout: Layout) -> None:
    for name, (dtype, _) in layout.items():
        joined = np.concatenate([part[name] for part in parts])
        # Strings keep the length of the longest one
        np.save(
            folder / f"{FILE_NAMES.get(name, name)}.npy",
            joined if dtype is np.bytes_ else joined.astype(dtype),
        )


@contextmanager
def _replacing(folder: Path) -> Iterator[Path]:
    """A new folder that takes the place of ``folder`` if all goes well, and vanishes otherwise."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    mark = uuid.uuid4().hex[:12]
    new, old = (folder.with_name(f".{folder.name}.{mark}.{what}") for what in ("new", "old"))
    new.mkdir()
    try:
        yield new
        if folder.exists():
            folder.rename(old)
        new.rename(folder)
    finally:
        for leftover in (new, old):
            shutil.rmtree(leftover, ignore_errors=True)


def _read_manifest(file: Path) -> Manifest:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"{file}: there is no such file; the cache has to be built") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{file}: cannot be read: {error}") from error
    version = content.get("format_version") if isinstance(content, dict) else None
    if isinstance(version, int) and version != FORMAT_VERSION:
        raise DataError(f"{file}: format version {version}, not {FORMAT_VERSION}; build the cache anew")
    try:
        manifest = Manifest.model_validate(content)
    except ValidationError as error:
        faults = (f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors())
        raise DataError(f"{file}: {'; '.join(faults)}") from error
    return manifest


def _check_key(folder: Path, found: CacheKey, wanted: CacheKey) -> None:
    pairs = zip(found, wanted, strict=True)
    differing = [f"{name} is {has}, not {want}" for (name, has), (_, want) in pairs if has != want]
    if differing:
        raise DataError(f"{folder}: a cache of something else: {'; '.join(differing)}")


def _open_arrays(folder: Path, count: int, layout: Layout) -> Arrays:
    return {
        name: _open_array(folder / f"{FILE_NAMES.get(name, name)}.npy", dtype, (count, *shape))
        for name, (dtype, shape) in layout.items()
    }


def _open_array(file: Path, dtype: type[np.generic], shape: tuple[int, ...]) -> Array:
    try:
        # Copy on write: torch takes no read-only arrays, and nobody may change the file
        array: Array = np.load(file, mmap_mode="c", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(f"{file}: missing or damaged: {error}") from error
    if array.shape != shape or not np.issubdtype(array.dtype, dtype):
        found, wanted = f"{array.dtype} {array.shape}", f"{np.dtype(dtype)} {shape}"
        raise DataError(f"{file}: holds {found}, not {wanted}")
    return array


def _open_rasters(file: Path, size: int) -> Bytes:
    try:
        found = file.stat().st_size
        if found != size:
            raise DataError(f"{file}: has {found} bytes, not {size}")
        return np.memmap(file, dtype=np.uint8, mode="c")
    except OSError as error:
        raise DataError(f"{file}: missing or damaged: {error}") from error
