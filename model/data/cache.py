"""Cache of a split: all its pairs as memory-mapped arrays, which training steps read without a data set.

A cache is a folder: a ``.npy`` file per array, ``rasters.u8`` and ``manifest.json``. Map patches in the
ground frame are cut from the rasters for each batch. ``model.data.cache_builder`` writes caches.
"""

import json
from dataclasses import dataclass
from pathlib import Path

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
    Array,
    Arrays,
    CacheKey,
    Layout,
    Manifest,
    neighbors_name,
    pair_layout,
)
from model.data.packing import unpack
from model.data.scenes import DataError
from model.features.agent_features import HISTORY_SCALE
from model.features.standardization import state_scale
from model.scenes.scene import AgentType, Raster

_GROUND_SCALE = state_scale(AgentType.VEHICLE, AgentType.VEHICLE)


@dataclass(frozen=True)
class Cache:
    """P pairs, ordered by scene, frame and track, of S scenes. Arrays are memory-mapped, copy on write."""

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
    """[P], rad, net turn of the heading from the first frame of history to the last of the future; left and
    right cancel out."""
    scene: Ints
    """[P], index into ``manifest.scenes``."""
    track: Ints
    """[P], index into the scene's tracks."""
    frame: Ints
    """[P], number of the 2 Hz frame now."""
    token: NDArray[np.bytes_]
    """[P], "instance_sample", ASCII; empty where the data has no tokens."""
    rasters: Bytes
    """Packed rasters, flat (``model.data.packing``)."""
    raster_start: Ints
    """[S], index in ``rasters`` at which each scene's raster starts."""
    raster_shape: Ints
    """[S, 2], rows and columns, without the border."""
    raster_origin: Floats
    """[S, 2], m."""
    raster_pixels_per_meter: Floats
    """[S]."""
    neighbor_boxes: Float32s | None = None
    """[P, B, 5], neighbours as boxes (``model.features.neighbor_boxes``); None: not in this cache."""
    speed: Float32s | None = None
    """[P], m/s along the heading now; this and the following arrays exist in the agents' frame only."""
    agents: Float32s | None = None
    """[P, M, 11], neighbours one by one (``model.features.agent_features``)."""
    near_patch: Bytes | None = None
    """[P, 100, 100], map patches of three layers a byte (``model.data.packing``)."""
    far_patch: Bytes | None = None
    """[P, 100, 100], the same of the far patches."""

    def __len__(self) -> int:
        """Return P."""
        return self.manifest.pairs

    def observed_positions(self) -> Floats:
        """Return past positions: [P, F, 2], m, relative to now, in the frame of the histories.

        They are NaN where the agent was not observed.
        """
        scale = HISTORY_SCALE if self.manifest.key.agent_frame else _GROUND_SCALE
        positions = np.array(self.history[..., :2]) * scale[:2]
        seen = np.arange(positions.shape[1]) >= self.first[:, None]
        return np.where(seen[..., None], positions, np.nan)

    def raster(self, scene: int) -> Raster:
        """Return the raster of a scene, as the reader gave it.

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
        """Open a cache that ``build_cache`` wrote.

        Args:
            folder: the cache.
            key: the key that it has to have; None: any.

        Raises:
            DataError: the cache is missing, damaged, stale, or has another key; names the differences.
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


def _read_manifest(file: Path) -> Manifest:
    """Return the manifest of a cache of the current format."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise DataError(f"{file}: there is no such file; the cache has to be built") from error
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{file}: cannot be read: {error}") from error
    version = content.get("format_version") if isinstance(content, dict) else None
    if isinstance(version, int) and version != FORMAT_VERSION:
        raise DataError(
            f"{file}: format version {version}, not {FORMAT_VERSION}; the cache has to be rebuilt"
        )
    try:
        manifest = Manifest.model_validate(content)
    except ValidationError as error:
        faults = (f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}" for fault in error.errors())
        raise DataError(f"{file}: {'; '.join(faults)}") from error
    return manifest


def _check_key(folder: Path, found: CacheKey, wanted: CacheKey) -> None:
    """Refuse a cache with another key."""
    pairs = zip(found, wanted, strict=True)
    differing = [f"{name} is {has}, not {want}" for (name, has), (_, want) in pairs if has != want]
    if differing:
        raise DataError(f"{folder}: the cache has other settings: {'; '.join(differing)}")


def _open_arrays(folder: Path, count: int, layout: Layout) -> Arrays:
    return {
        name: _open_array(folder / f"{FILE_NAMES.get(name, name)}.npy", dtype, (count, *shape))
        for name, (dtype, shape) in layout.items()
    }


def _open_array(file: Path, dtype: type[np.generic], shape: tuple[int, ...]) -> Array:
    try:
        # Copy on write: torch takes no read-only arrays, and the file must not change
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
