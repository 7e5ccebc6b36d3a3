"""The agents around an agent, as boxes in its own frame: for networks that look at a picture of the scene."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Float32s, Floats, Ints
from model.geometry import rotate, wrap_angle
from model.scenes.raster import COLUMNS_RIGHT, PATCH_PIXELS_PER_METER, PATCH_SIZE, ROWS_BEHIND
from model.scenes.scene import AgentType, Scene

BOXES = 32
"""S, of an agent at most; the nearest count."""
BOX_SIZE = {AgentType.VEHICLE: (4.5, 2.0), AgentType.PEDESTRIAN: (0.8, 0.8)}
"""m, length and width that agents of a type are taken to have: requests tell no sizes."""
BOX_REACH = max(float(np.hypot(*size)) / 2 for size in BOX_SIZE.values())
"""m, from a box's middle to its farthest corner, at most."""
BOX_NUMBERS = 5
"""Numbers that tell a box: ahead and left of the agent (m), heading relative to the agent's (rad), length and
width (m)."""

_LOW = np.array([-ROWS_BEHIND, -COLUMNS_RIGHT]) / PATCH_PIXELS_PER_METER - BOX_REACH
_HIGH = _LOW + PATCH_SIZE / PATCH_PIXELS_PER_METER + 2 * BOX_REACH


def surroundings(scene: Scene, targets: Ints, types: Sequence[AgentType]) -> Float32s:
    """The agents that reach into the map patch of each target, at their places now.

    A box whose heading is not known lies as the target does.

    Args:
        scene: the agents.
        targets: [n], indices of agents, each with a heading now.
        types: of agents that are wanted, of ``BOX_SIZE``.

    Returns:
        [n, S, 5], ``BOX_NUMBERS``, nearest first; zeros behind the last one.
    """
    boxes = np.zeros((len(targets), BOXES, BOX_NUMBERS), dtype=np.float32)
    others = np.flatnonzero([kind in types for kind in scene.types])
    if not (len(others) and len(targets)):
        return boxes
    position, heading = scene.states.position[:, -1], scene.states.heading[:, -1]
    offset = position[others][None] - position[targets][:, None]
    place = rotate(offset, -heading[targets][:, None])  # NaN where not observed now
    turn = np.nan_to_num(wrap_angle(heading[others][None] - heading[targets][:, None]))
    size = np.array([BOX_SIZE[scene.types[other]] for other in others.tolist()])
    told: Floats = np.concatenate(
        [place, turn[..., None], np.broadcast_to(size, place.shape)], axis=-1
    )  # [n, m, 5]
    with np.errstate(invalid="ignore"):
        seen = ((place > _LOW) & (place < _HIGH)).all(axis=-1)
    seen &= targets[:, None] != others[None, :]
    distance = np.where(seen, np.hypot(place[..., 0], place[..., 1]), np.inf)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :BOXES]
    kept = np.take_along_axis(seen, nearest, axis=1)[..., None]
    picked = np.take_along_axis(told, nearest[..., None], axis=1)
    boxes[:, : nearest.shape[1]] = np.where(kept, picked, 0.0)
    return boxes
