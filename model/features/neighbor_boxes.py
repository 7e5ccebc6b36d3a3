"""The agents around an agent, as boxes in its own frame: for networks that look at a picture of the scene."""

from collections.abc import Sequence

import numpy as np

from model.arrays import Bools, Float32s, Floats, Ints
from model.geometry import nearest_rows, rotate, wrap_angle
from model.scenes.raster import COLUMNS_RIGHT, PATCH_PIXELS_PER_METER, PATCH_SIZE, ROWS_BEHIND
from model.scenes.scene import AgentType, Scene

BOXES = 32
"""S, maximum number of boxes of an agent; the nearest are taken."""
BOX_SIZE = {AgentType.VEHICLE: (4.5, 2.0), AgentType.PEDESTRIAN: (0.8, 0.8)}
"""m, assumed length and width of agents of a type: requests carry no sizes."""
BOX_REACH = max(float(np.hypot(*size)) / 2 for size in BOX_SIZE.values())
"""m, maximum distance from a box's middle to its farthest corner."""
BOX_NUMBERS = 5
"""Numbers of a box: ahead and left of the agent (m), heading relative to the agent's (rad), length and width
(m)."""

_LOW = np.array([-ROWS_BEHIND, -COLUMNS_RIGHT]) / PATCH_PIXELS_PER_METER - BOX_REACH
_HIGH = _LOW + PATCH_SIZE / PATCH_PIXELS_PER_METER + 2 * BOX_REACH


def neighbor_boxes(scene: Scene, targets: Ints, types: Sequence[AgentType]) -> Float32s:
    """Return the agents that reach into the map patch of each target, at their places now.

    A box of unknown heading gets the heading of the target.

    Args:
        scene: the agents.
        targets: [n], indices of agents, each with a heading now.
        types: types of agents to return, each in ``BOX_SIZE``.

    Returns:
        [n, S, 5], ``BOX_NUMBERS``, nearest first; zeros behind the last one.
    """
    others = np.flatnonzero([kind in types for kind in scene.types])
    if not (len(others) and len(targets)):
        return np.zeros((len(targets), BOXES, BOX_NUMBERS), dtype=np.float32)
    heading = scene.states.heading[:, -1]
    place, seen = _places(scene, targets, others)
    turn = np.nan_to_num(wrap_angle(heading[others][None] - heading[targets][:, None]))
    size = np.array([BOX_SIZE[scene.types[other]] for other in others.tolist()])
    boxes: Floats = np.concatenate(
        [place, turn[..., None], np.broadcast_to(size, place.shape)], axis=-1
    )  # [n, m, 5]
    distance = np.hypot(place[..., 0], place[..., 1])
    return nearest_rows(boxes, distance, seen, BOXES).astype(np.float32)


def seen_as_boxes(scene: Scene, targets: Ints, types: Sequence[AgentType]) -> Bools:
    """Return which agents of the scene n agents can have among their ``neighbor_boxes``: [n, N]."""
    others = np.flatnonzero([kind in types for kind in scene.types])
    mask = np.zeros((len(targets), len(scene.types)), dtype=np.bool_)
    mask[:, others] = _places(scene, targets, others)[1]
    return mask


def _places(scene: Scene, targets: Ints, others: Ints) -> tuple[Floats, Bools]:
    """Return where n agents see m others, m ahead and to the left, NaN where not observed now; and whether.

    Returns:
        [n, m, 2]; [n, m].
    """
    position, heading = scene.states.position[:, -1], scene.states.heading[:, -1]
    offset = position[others][None] - position[targets][:, None]
    place = rotate(offset, -heading[targets][:, None])
    with np.errstate(invalid="ignore"):
        seen: Bools = np.asarray(((place > _LOW) & (place < _HIGH)).all(axis=-1))
    seen &= targets[:, None] != others[None, :]
    return place, seen
