"""Motion along a path: lines and arcs, driven through with constant acceleration."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Piece:
    """A stretch of constant curvature."""

    length: float
    """m."""
    curvature: float = 0.0
    """1/m, positive to the left; 0: straight."""


@dataclass(frozen=True)
class Path:
    """A line to move along, without kinks; before its start and after its end it goes straight on."""

    x: float
    """Where it starts, m."""
    y: float
    heading: float
    """Where it leads there, rad."""
    pieces: Sequence[Piece] = ()

    def poses(self, distances: Floats) -> Floats:
        """Where one is after so many metres.

        Args:
            distances: [F], m from the start; negative: before it.

        Returns:
            [F, 3], x and y in m, heading in rad.
        """
        return np.array([self._pose(float(distance)) for distance in distances]).reshape(-1, 3)

    def _pose(self, distance: float) -> tuple[float, float, float]:
        pose = (self.x, self.y, self.heading)
        for piece in self.pieces:
            if distance <= 0.0:
                break
            covered = min(distance, piece.length)
            pose = _advance(pose, covered, piece.curvature)
            distance -= covered
        return _advance(pose, distance, 0.0)


@dataclass(frozen=True)
class Motion:
    """Speed up to now: constant acceleration, but never backwards."""

    path: Path
    distance: float
    """How far along the path one is now, m."""
    speed: float
    """Now, m/s, at least 0."""
    acceleration: float = 0.0
    """m/s², held all the time."""

    def history(self, times: Floats) -> tuple[Floats, Floats]:
        """What was observed.

        Args:
            times: [F], s from now, none positive.

        Returns:
            [F, 3] poses (x, y, heading) and [F, 2] velocities in m/s.

        Raises:
            ValueError: the speed would have been negative.
        """
        speeds = self.speed + self.acceleration * times
        if (speeds < 0).any():
            raise ValueError("no one drives backwards here")
        distances = self.distance + self.speed * times + self.acceleration * times**2 / 2
        poses = self.path.poses(distances)
        directions = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], axis=-1)
        return poses, speeds[:, None] * directions


def _advance(
    pose: tuple[float, float, float], distance: float, curvature: float
) -> tuple[float, float, float]:
    x, y, heading = pose
    if curvature == 0.0:
        return x + distance * math.cos(heading), y + distance * math.sin(heading), heading
    turned = heading + curvature * distance
    return (
        x + (math.sin(turned) - math.sin(heading)) / curvature,
        y - (math.cos(turned) - math.cos(heading)) / curvature,
        turned,
    )
