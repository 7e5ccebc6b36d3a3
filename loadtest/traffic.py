"""Synthetic vehicles: each drives in a circle at its own speed."""

import numpy as np

from cab.forecast.v1.prediction_service_pb2 import Agent
from cab_forecast import agent

START = 1_700_000_000.0
"""s since the epoch."""
STEP = 0.5
"""Seconds between the states of a history."""

_FIELD = 400.0
"""Side of the square that the circles are spread over, m."""
_SPEEDS = (3.0, 15.0)
"""m/s."""
_RADII = (30.0, 200.0)
"""m."""


class Traffic:
    """Vehicles, reproducible by seed.

    Args:
        count: number of vehicles.
        seed: seed of their circles and speeds.
    """

    def __init__(self, count: int, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self._centers = random.uniform(0, _FIELD, (count, 1, 2))
        self._radii = random.uniform(*_RADII, (count, 1))
        self._speeds = random.uniform(*_SPEEDS, (count, 1))
        self._angles = random.uniform(0, 2 * np.pi, (count, 1))

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
