"""The input of forecasters: agents' states on the 0.5 s grid, and the map."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from enum import StrEnum

import numpy as np

from model.arrays import Bools, Bytes, Float32s, Floats, Ints

STEP_SECONDS = 0.5
"""Time between frames of history and between steps of a forecast (nuScenes keyframes, 2 Hz)."""


class AgentType(StrEnum):
    """Types of road users."""

    VEHICLE = "vehicle"
    PEDESTRIAN = "pedestrian"
    CYCLIST = "cyclist"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class AgentStates:
    """States of N agents on the grid time − k · 0.5 s, F frames, oldest first; the last frame is now.

    Frames before ``first`` are NaN. SI units, ground frame, float64: relative positions are computed before
    anything is converted to float32.
    """

    position: Floats
    """[N, F, 2], m."""
    velocity: Floats
    """[N, F, 2], m/s."""
    acceleration: Floats
    """[N, F, 2], m/s²."""
    heading: Floats
    """[N, F], rad in [-π, π); NaN where neither given nor known from motion."""
    heading_rate: Floats
    """[N, F], rad/s."""
    first: Ints
    """[N], first frame of the unbroken run of observations that ends now; F: not observed now."""
    velocity_known: Bools
    """[N], whether the velocity now was given or could be derived; otherwise it is zero."""

    @property
    def frames(self) -> int:
        """F, number of frames."""
        return int(self.position.shape[1])

    @property
    def observed(self) -> Bools:
        """[N, F], whether the agent was observed in the frame."""
        return np.arange(self.frames)[None, :] >= self.first[:, None]

    def last_frames(self, frames: int) -> "AgentStates":
        """Return the newest ``frames`` frames, or all of them if there are fewer."""
        cut = max(self.frames - frames, 0)
        return replace(
            self,
            position=self.position[:, cut:],
            velocity=self.velocity[:, cut:],
            acceleration=self.acceleration[:, cut:],
            heading=self.heading[:, cut:],
            heading_rate=self.heading_rate[:, cut:],
            first=np.maximum(self.first - cut, 0),
        )

    def require_observed(self, targets: Ints) -> None:
        """Refuse agents that are not observed now.

        Args:
            targets: [n], indices of agents.

        Raises:
            ValueError: a target is not observed now.
        """
        absent = targets[self.first[targets] >= self.frames]
        if len(absent):
            raise ValueError(f"agents {absent.tolist()} are not observed now, so they cannot be forecast")

    def select(self, agents: Bools | Ints) -> "AgentStates":
        """Return some of the agents, by mask [N] or indices [n]."""
        return AgentStates(**{field.name: getattr(self, field.name)[agents] for field in fields(self)})


@dataclass(frozen=True)
class Raster:
    """The map of a scene, in three layers: 0 drivable area, 1 road dividers, 2 lane dividers.

    Element [layer, i, j] shows the ground point ``origin + (i, j) / pixels_per_meter``.
    """

    layers: Bytes
    """[3, rows, columns], 0 or 1."""
    origin: Floats
    """[2], m."""
    pixels_per_meter: float


@dataclass(frozen=True)
class Scene:
    """The agents of one place at one time, and its map."""

    types: Sequence[AgentType]
    """[N]."""
    states: AgentStates
    raster: Raster | None = None
    patches: dict[int, Bytes | Float32s] = field(default_factory=dict)
    """Agents' own map patches by agent index, each [3, 100, 100] in [0, 1]; they take precedence over the
    raster."""
    far_patches: dict[int, Bytes | Float32s] = field(default_factory=dict)
    """Agents' own far map patches, each [3, 100, 100] in [0, 1], 1.4 pixels per metre: element [layer, i, j]
    shows the point (i − 14)/1.4 m ahead and (j − 50)/1.4 m to the left. They, too, take precedence over the
    raster."""

    def of_type(self, kind: AgentType) -> Bools:
        """Return a mask of the agents of that type: [N]."""
        return np.array([t is kind for t in self.types], dtype=np.bool_)
