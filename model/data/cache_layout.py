"""What a cache of pairs consists of, and how one tells whether it is the right one."""

from typing import TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from model.data.checks import FUTURE_STEPS
from model.data.scenes import Reader
from model.features.agent_features import NEIGHBOR_FEATURES, NEIGHBORS
from model.features.neighbor_boxes import BOX_NUMBERS, BOXES
from model.features.spec import Frame
from model.features.standardization import STATE_SIZE
from model.forecaster import Protocol
from model.networks.config import AnyNetworkConfig, CoverNetConfig, NetworkConfig
from model.scenes.raster import PATCH_SIZE
from model.scenes.scene import AgentType

FORMAT_VERSION = 3
"""Version of the folder's layout and of how its arrays are derived from the data: whoever changes either
(resampling, features, sensing) raises it, and caches of other versions are built anew."""
MANIFEST_FILE = "manifest.json"
RASTERS_FILE = "rasters.u8"

Layout: TypeAlias = dict[str, tuple[type[np.generic], tuple[int, ...]]]
"""Type and shape, without the first axis, of arrays by name."""

SCENE_LAYOUT: Layout = {
    "raster_start": (np.int64, ()),
    "raster_shape": (np.int64, (2,)),
    "raster_origin": (np.float64, (2,)),
    "raster_pixels_per_meter": (np.float64, ()),
}
"""Arrays with a row per scene."""

FILE_NAMES = {"neighbor_boxes": "surroundings"}
"""File names, without their ending, of arrays that were renamed in the code: older caches go on loading."""


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
    agent_frame: bool = False
    """Whether features are in the agents' own frames; such caches hold map patches and neighbours one by
    one, whatever of them a network takes."""
    variants: int = Field(default=0, ge=0)
    """V, how many noisy reports of each pair (``model.data.sensing``) are held beside the recorded states."""

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
        """Return the key of the cache that ``build_cache`` makes of the same arguments."""
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
        """Types whose summed histories are held."""
        return () if self.drawn or self.agent_frame else self.neighbor_types


class Manifest(BaseModel):
    """What manifest.json holds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format_version: int
    key: CacheKey
    pairs: int = Field(ge=1)
    """Rows: each pair has one, and after it one for each of its variants."""
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
    """Whether a network's features are in the agents' own frames."""
    return isinstance(config, NetworkConfig) and config.frame is Frame.AGENT


def draws(config: AnyNetworkConfig) -> bool:
    """Whether the network looks at its neighbours as boxes in a picture."""
    return isinstance(config, CoverNetConfig) and bool(config.neighbor_types)


def neighbors_name(kind: AgentType) -> str:
    """Name of the summed histories of neighbours of a type, in caches as in features."""
    return f"neighbors.{kind.value}"
