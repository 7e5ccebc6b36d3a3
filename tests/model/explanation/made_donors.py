"""Donors of small numbers for tests."""

import numpy as np

from model.arrays import Floats
from model.explanation.donors import Donors

FRAMES, NEIGHBORS = 5, 3


def straight(speed: float, x: float = 0.0, y: float = 0.0) -> Floats:
    """Return the history of a vehicle that drives along x and is at (x, y) now: [F, 8]."""
    history = np.zeros((FRAMES, 8))
    history[:, 0] = x + 0.5 * speed * np.arange(1 - FRAMES, 1)
    history[:, 1] = y
    history[:, 2] = speed
    return history


def donors(*speeds: float, seed: int = 0) -> Donors:
    """Return donors that drive straight on, each with road everywhere and neighbours ahead and beside."""
    random = np.random.default_rng(seed)
    count = len(speeds)
    neighbors = np.full((count, NEIGHBORS, FRAMES, 8), np.nan)
    kinds = np.full((count, NEIGHBORS), 255, dtype=np.uint8)
    for row in range(count):
        for place in range(NEIGHBORS):
            x, y = random.uniform(8, 20), random.choice([-4.0, 4.0])
            neighbors[row, place] = straight(random.uniform(0, 8), x, y)
            kinds[row, place] = place % 2
    near, far = (random.integers(0, 2, (count, 3, 100, 100), dtype=np.uint8) for _ in range(2))
    near[:, 0], far[:, 0] = 1, 1
    return Donors(
        history=np.stack([straight(speed) for speed in speeds]),
        neighbors=neighbors,
        kinds=kinds,
        near=near,
        far=far,
        weight=np.full(count, 1 / count),
        source="made up",
        license="none",
    )
