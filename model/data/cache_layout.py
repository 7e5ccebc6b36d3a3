"""Layout of a cache of pairs, and the settings and the version that decide whether it is valid."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from model.data.checks import FUTURE_STEPS
from model.data.scenes import Reader
from model.features.agent_features import NEIGHBOR_FEATURES, NEIGHBORS
from model.features.neighbor_boxes import BOX_NUMBERS, BOXES
from model.features.spec import Frame
from model.features.standardization import STATE_SIZE
from model.forecaster import Protocol
from model.networks.config import AnyNetworkConfig, NetworkConfig
from model.scenes.raster import PATCH_SIZE
from model.scenes.scene import AgentType

FORMAT_VERSION = 3
"""Version of the folder's layout and of the derivation of its arrays.

A cache is valid if it has this version and the same key. So the version must be raised with every change that
alters what a cache holds: the layout, readers, resampling, features, sensing, packing. Caches of other
versions are then rebuilt. Made-up scenes have a version of their own (``synthetic.VERSION``), in the key.
"""
MANIFEST_FILE = "manifest.json"
RASTERS_FILE = "rasters.u8"

Array: TypeAlias = NDArray[Any]
Arrays: TypeAlias = dict[str, Array]
"""Arrays by name."""
Layout: TypeAlias = dict[str, tuple[type[np.generic], tuple[int, ...]]]
"""Type and shape, without the first axis, of arrays by name."""

SCENE_LAYOUT: Layout = {
    "raster_start": (np.int64, ()),
    "raster_shape": (np.int64, (2,)),
    "raster_origin": (np.float64, (2,)),
    "raster_pixels_per_meter": (np.float64, ()),
}
"""Arrays with one row per scene."""

FILE_NAMES = {"neighbor_boxes": "surroundings"}
"""File names, without their ending, of arrays that were renamed in the code: older caches go on loading."""


class CacheKey(BaseModel):
    """Settings that determine what a cache holds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    reader: str
    """Name of the reader's class."""
    data: str = ""
    """Place of the data, so that two data sets never share a cache."""
    split: str
    protocol: Protocol
    history_frames: int = Field(ge=1)
    neighbor_types: tuple[AgentType, ...]
    """Types in the network's configuration; little else of it changes the arrays, so methods share caches."""
    drawn: bool = False
    """True if neighbours are held as boxes to be drawn (CoverNet) instead of summed histories."""
    agent_frame: bool = False
    """True if features are in the agents' own frames. Such caches hold map patches and single neighbours,
    whether or not a network uses them."""
    variants: int = Field(default=0, ge=0)
    """V, number of noisy reports of each pair (``model.data.sensing``) beside the recorded states."""

    @classmethod
    def of(
        cls,
        reader: Reader,
        split: str,
        protocol: Protocol,
        config: AnyNetworkConfig,
        history_frames: int,
        variants: int = 0,
    ) -> "CacheKey":
        """Return the key of the cache that ``build_cache`` makes from the same arguments."""
        own_frame = in_agent_frame(config)
        return cls(
            reader=type(reader).__name__,
            data=reader.place,
            split=split,
            protocol=protocol,
            history_frames=history_frames,
            neighbor_types=NetworkConfig().neighbor_types if own_frame else config.neighbor_types,
            drawn=draws(config),
            agent_frame=own_frame,
            variants=variants if own_frame else 0,
        )

    @property
    def summed_types(self) -> tuple[AgentType, ...]:
        """Types of neighbours whose summed histories are held."""
        return () if self.drawn or self.agent_frame else self.neighbor_types


class Manifest(BaseModel):
    """Content of manifest.json."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format_version: int
    key: CacheKey
    pairs: int = Field(ge=1)
    """Number of rows: each pair has one, followed by one for each of its variants."""
    scenes: tuple[str, ...]
    """Names of the scenes; the array ``scene`` has indices into them."""
    raster_bytes: int = Field(ge=1)


def pair_layout(key: CacheKey) -> Layout:
    """Return the layout of the arrays with one row per pair. ``token`` is a byte string of any length."""
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
        layout["neighbor_boxes"] = (np.float32, (BOXES, BOX_NUMBERS))
    if key.agent_frame:
        layout |= {
            "speed": (np.float32, ()),
            "agents": (np.float32, (NEIGHBORS, NEIGHBOR_FEATURES)),
            "near_patch": (np.uint8, (PATCH_SIZE, PATCH_SIZE)),
            "far_patch": (np.uint8, (PATCH_SIZE, PATCH_SIZE)),
        }
    return layout


def in_agent_frame(config: AnyNetworkConfig) -> bool:
    """Return whether a network's features are in the agents' own frames."""
    return config.frame is Frame.AGENT


def draws(config: AnyNetworkConfig) -> bool:
    """Return whether a network sees its neighbours as boxes in a picture."""
    return config.features.neighbor_boxes and bool(config.neighbor_types)


def neighbors_name(kind: AgentType) -> str:
    """Return the name of the summed histories of neighbours of a type, in caches and features."""
    return f"neighbors.{kind.value}"
