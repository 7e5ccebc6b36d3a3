"""A fan of simple paths: is there any way for an agent to stay on the road?

Where every path of the fan leaves the driveable area, a forecast that leaves it says nothing about the model.
"""

from typing import Final

import numpy as np

from model.arrays import Floats
from model.geometry import rotate
from model.metrics.offroad import off_road
from model.scenes.scene import STEP_SECONDS, Raster

CURVATURES: Final = np.linspace(-0.2, 0.2, 21)
"""1/m, to the left; the tightest radius is 5 m."""
ACCELERATIONS: Final = np.array([-3.0, -2.0, -1.0, 0.0, 1.0, 2.0])
"""m/s²; an agent that brakes stops, and does not reverse."""
LATERAL_LIMIT: Final = 4.0
"""m/s², lateral acceleration beyond which a path is no way to drive."""


def path_fan(position: Floats, heading: float, speed: float, steps: int) -> Floats:
    """Return the paths of constant curvature and acceleration that an agent could drive.

    Args:
        position: [2], m, ground frame.
        heading: rad.
        speed: m/s.
        steps: T, number of steps of 0.5 s.

    Returns:
        [P, T, 2], m, ground frame. Straight paths are always among them; P depends on the speed.
    """
    time = STEP_SECONDS * np.arange(1, steps + 1)
    stop = np.where(ACCELERATIONS < 0, -speed / np.minimum(ACCELERATIONS, -1e-9), np.inf)
    driven = np.minimum(time, stop[:, None])  # [A, T], s until the agent stands
    length = speed * driven + 0.5 * ACCELERATIONS[:, None] * driven**2
    fastest = np.maximum(speed, speed + ACCELERATIONS * time[-1])
    curvature, _ = (grid.ravel() for grid in np.meshgrid(CURVATURES, ACCELERATIONS, indexing="ij"))
    length, fastest = np.tile(length, (len(CURVATURES), 1)), np.tile(fastest, len(CURVATURES))
    fair = np.abs(curvature) * fastest**2 <= LATERAL_LIMIT
    length, turned = length[fair], curvature[fair, None] * length[fair]
    # numpy's sinc(x) is sin(πx)/(πx): the straight path is no special case
    ahead = length * np.sinc(turned / np.pi)
    left = length * np.sin(turned / 2) * np.sinc(turned / (2 * np.pi))
    return position + rotate(np.stack([ahead, left], axis=-1), np.asarray(heading))


def on_road_path_exists(raster: Raster, position: Floats, heading: float, speed: float, steps: int) -> bool:
    """Return whether a path of the fan stays on the driveable area; arguments as for ``path_fan``."""
    return bool((off_road(raster, path_fan(position, heading, speed, steps)) == 0).any())
