"""Angles and planar rotations."""

import numpy as np

from model.arrays import Floats


def wrap_angle(angle: Floats) -> Floats:
    """Return angles wrapped into [-π, π).

    Args:
        angle: any shape, rad.
    """
    return (angle + np.pi) % (2 * np.pi) - np.pi


def rotate(vectors: Floats, angle: Floats) -> Floats:
    """Rotate vectors counter-clockwise.

    Args:
        vectors: [..., 2].
        angle: broadcasts against the leading shape, rad.
    """
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def rotation_matrices(angle: Floats) -> Floats:
    """Return matrices R for which R @ v is v rotated counter-clockwise by the angle: [..., 2, 2]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], axis=-1), np.stack([sin, cos], axis=-1)], axis=-2)
