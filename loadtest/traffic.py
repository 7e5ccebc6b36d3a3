"""Synthetic vehicles: each drives in a circle at its own speed, on a road of its own."""

import numpy as np

from cab.forecast.v1.prediction_service_pb2 import Agent
from cab_forecast import agent
from model.arrays import Bytes

START = 1_700_000_000.0
"""s since the epoch."""
STEP = 0.5
"""Seconds between the states of a history."""

FIELD = 400
"""Side of the square that the circles lie in, m."""
_ROAD = 12.0
"""Width of a road, m."""
_DIVIDER = 1.0
"""Width of what divides its lanes, m."""
_SPEEDS = (3.0, 15.0)
"""m/s."""
_RADII = (30.0, 190.0)
"""m."""


class Traffic:
    """Vehicles, reproducible by seed.

    Args:
        count: number of vehicles.
        seed: seed of their circles and speeds.
    """

    def __init__(self, count: int, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self._radii = random.uniform(*_RADII, (count, 1))
        room = FIELD / 2 - self._radii[..., None]
        self._centers = FIELD / 2 + room * random.uniform(-1.0, 1.0, (count, 1, 2))
        self._speeds = random.uniform(*_SPEEDS, (count, 1))
        self._angles = random.uniform(0, 2 * np.pi, (count, 1))

    def roads(self) -> Bytes:
        """Return the roads as a raster of one pixel a metre whose origin is 0: [3, 400, 400], 0 or 1."""
        layers = np.zeros((3, FIELD, FIELD), dtype=np.uint8)
        x, y = np.mgrid[:FIELD, :FIELD]
        for (center_x, center_y), radius in zip(self._centers[:, 0], self._radii[:, 0], strict=True):
            off = np.abs(np.hypot(x - center_x, y - center_y) - radius)
            layers[0] |= off < _ROAD / 2
            layers[1] |= off < _DIVIDER / 2
        return layers

    def agents(self, time: float, states: int) -> list[Agent]:
        """Return all vehicles with their states up to a time, ``STEP`` apart.

        Args:
            time: seconds since the epoch; not before ``START``.
            states: states per vehicle.
        """
        times = time - STEP * np.arange(states - 1, -1, -1)
        angles = self._angles + self._speeds / self._radii * (times - START)
        outward = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        onward = np.stack([-np.sin(angles), np.cos(angles)], axis=-1)
        positions = self._centers + self._radii[..., None] * outward
        velocities = self._speeds[..., None] * onward
        headings = angles + np.pi / 2
        return [
            agent(
                f"vehicle-{index}",
                "vehicle",
                times,
                positions[index],
                headings=headings[index],
                velocities=velocities[index],
            )
            for index in range(len(positions))
        ]
