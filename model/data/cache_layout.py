"""What a cache of pairs consists of, and how one tells whether it is the right one."""

import hashlib
import inspect
from typing import TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from model import features, fit, geometry, inputs, neighbors, raster, resample, standardization, surroundings
from model.data import packing, protocols
from model.data.checks import FUTURE_STEPS
from model.data.scenes import Reader
from model.forecaster import Protocol
from model.networks.config import AnyNetworkConfig, CoverNetConfig
from model.scene import AgentType
from model.standardization import STATE_SIZE
from model.surroundings import BOX_NUMBERS, BOXES

FORMAT_VERSION = 1
"""Of the folder's layout; what reads one version reads no other."""
MANIFEST_FILE = "manifest.json"
RASTERS_FILE = "rasters.u8"

_DERIVED_BY = (resample, fit, features, neighbors, standardization, geometry, protocols, packing)
_DRAWN_BY = (inputs, surroundings, raster)

Layout: TypeAlias = dict[str, tuple[type[np.generic], tuple[int, ...]]]
"""Type and shape, without the first axis, of arrays by name."""

SCENE_LAYOUT: Layout = {
    "raster_start": (np.int64, ()),
    "raster_shape": (np.int64, (2,)),
    "raster_origin": (np.float64, (2,)),
    "raster_pixels_per_meter": (np.float64, ()),
}
"""Arrays with a row per scene."""


class CacheKey(BaseModel):
    """What a cache is of."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reader: str
    """Class of the reader."""
    data: str = ""
    """Where it reads: two data sets never share a cache by mistake."""
    split: str
    protocol: Protocol
    history_frames: int = Field(ge=1)
    neighbor_types: tuple[AgentType, ...]
    """Of the network's configuration; little else of it changes the arrays, so methods share caches."""
    drawn: bool = False
    """Whether neighbours are held as boxes to be drawn (CoverNet) instead of as summed histories."""

    @classmethod
    def of(
        cls, reader: Reader, split: str, protocol: Protocol, config: AnyNetworkConfig, history_frames: int
    ) -> "CacheKey":
        """The key of the cache that ``build_cache`` makes of the same arguments."""
        return cls(
            reader=type(reader).__name__,
            data=reader.place,
            split=split,
            protocol=protocol,
            history_frames=history_frames,
            neighbor_types=config.neighbor_types,
            drawn=draws(config),
        )

    @property
    def summed_types(self) -> tuple[AgentType, ...]:
        """Types whose summed histories are held."""
        return () if self.drawn else self.neighbor_types


class Manifest(BaseModel):
    """What manifest.json holds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format_version: int
    derivation: str
    """Digest of the code that the arrays come out of."""
    key: CacheKey
    pairs: int = Field(ge=1)
    scenes: tuple[str, ...]
    """Names; the array ``scene`` counts them."""
    raster_bytes: int = Field(ge=1)


def pair_layout(key: CacheKey) -> Layout:
    """Arrays with a row per pair. ``token`` is a byte string of any length."""
    frames = key.history_frames
    layout: Layout = {
        "history": (np.float32, (frames, STATE_SIZE[AgentType.VEHICLE])),
        "first": (np.int64, ()),
        "velocity": (np.float32, (2,)),
        "edge_mask": (np.float32, ()),
        "future": (np.float32, (FUTURE_STEPS, 2)),
        "position": (np.float64, (2,)),
        "heading": (np.float64, ()),
        "turn": (np.float32, ()),
        "scene": (np.int64, ()),
        "track": (np.int64, ()),
        "frame": (np.int64, ()),
        "token": (np.bytes_, ()),
    }
    for kind in key.summed_types:
        layout[neighbors_name(kind)] = (np.float32, (frames, STATE_SIZE[kind]))
    if key.drawn:
        layout["surroundings"] = (np.float32, (BOXES, BOX_NUMBERS))
    return layout


def draws(config: AnyNetworkConfig) -> bool:
    """Whether the network looks at its neighbours as boxes in a picture."""
    return isinstance(config, CoverNetConfig) and bool(config.neighbor_types)


def neighbors_name(kind: AgentType) -> str:
    """Name of the summed histories of neighbours of a type, in caches as in features."""
    return f"neighbors.{kind.value}"


def derivation(key: CacheKey) -> str:
    """Digest of the code that arrays come out of: a cache that other code has made is stale."""
    digest = hashlib.sha256()
    for module in (*_DERIVED_BY, *(_DRAWN_BY if key.drawn else ())):
        digest.update(inspect.getsource(module).encode())
    return digest.hexdigest()
