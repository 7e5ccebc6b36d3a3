"""Motion with constant acceleration along a path of lines and arcs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Segment:
    """A segment of constant curvature."""

    length: float
    """Metres."""
    curvature: float = 0.0
    """1/m, positive to the left; 0: straight."""


@dataclass(frozen=True)
class Path:
    """A smooth path of segments, extended by straight lines before its start and after its end."""

    x: float
    """Start position, m."""
    y: float
    heading: float
    """Heading at the start, rad."""
    segments: Sequence[Segment] = ()

    def poses(self, distances: Floats) -> Floats:
        """Return the poses at distances along the path.

        Args:
            distances: [F], m from the start; negative: before it.

        Returns:
            [F, 3], x and y in m, heading in rad.
        """
        return np.array([self._pose(float(distance)) for distance in distances]).reshape(-1, 3)

    def _pose(self, distance: float) -> tuple[float, float, float]:
        pose = (self.x, self.y, self.heading)
        for segment in self.segments:
            if distance <= 0.0:
                break
            covered = min(distance, segment.length)
            pose = _advance(pose, covered, segment.curvature)
            distance -= covered
        return _advance(pose, distance, 0.0)


@dataclass(frozen=True)
class Motion:
    """Motion along a path up to the present, with constant acceleration and without reversing."""

    path: Path
    distance: float
    """Current distance along the path, m."""
    speed: float
    """Current speed, m/s, at least 0."""
    acceleration: float = 0.0
    """Constant acceleration, m/s²."""

    def history(self, times: Floats) -> tuple[Floats, Floats]:
        """Return the observations of the motion.

        Args:
            times: [F], seconds from the present, none positive.

        Returns:
            [F, 3] poses (x, y, heading) and [F, 2] velocities in m/s.

        Raises:
            ValueError: the speed would have been negative.
        """
        speeds = self.speed + self.acceleration * times
        if (speeds < 0).any():
            raise ValueError("the speed would have been negative")
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
