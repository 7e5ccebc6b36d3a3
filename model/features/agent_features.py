"""The tensors that a network of the agent's frame takes of a scene."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch

from model.arrays import Bools, Float32s, Floats, Ints
from model.features.spec import FeatureSpec
from model.forecaster import Context, Features, Prepared, complete
from model.geometry import known_or_zero, nearest_rows, rotate, wrap_angle
from model.scenes.raster import FAR, NEAR, MapView, map_view
from model.scenes.scene import AgentStates, AgentType, Scene

HISTORY_SCALE = np.array([20.0, 5.0, 15.0, 5.0, 3.0, 3.0, 0.5, 0.5])
"""Divisors of x, y, vx, vy, ax, ay, heading and heading rate of a history (m, m/s, m/s², rad, rad/s).
Across the agent everything is smaller than along it."""
NEIGHBORS = 16
"""M, maximum number of neighbours of an agent; the nearest are taken."""
NEIGHBOR_REACH_M = 60.0
"""m; agents farther away now are no neighbours."""
NEIGHBOR_POSITION_SCALE = 30.0
NEIGHBOR_VELOCITY_SCALE = 15.0
NEIGHBOR_ACCELERATION_SCALE = 4.0
NEIGHBOR_FEATURES = 11
"""Numbers of a neighbour: x, y, cosine and sine of its heading (zeros where unknown), vx, vy, ax, ay, all in
the agent's frame, 1 for a vehicle, 1 for a pedestrian, and 1 for presence (0 where there is no neighbour)."""
PATCHES: Final = {"map": NEAR, "far_map": FAR}
"""Geometry of the map patches, by the name of the feature."""
OUTSIDE: Final = 0.5
"""Value of a patch's pixels outside the raster, in [0, 1]: unknown."""
_NEIGHBOR_KINDS = (AgentType.VEHICLE, AgentType.PEDESTRIAN)


def agent_frame_features(scene: Scene, targets: Ints, spec: FeatureSpec, context: Context) -> Features:
    """Return features of n vehicles, each in its own frame: origin at its position now, x along its heading.

    Returns:
        ``origin`` [n, 2] and ``heading`` [n], both float64: the frame, m and rad in the ground frame.
        All else float32: ``speed`` [n], m/s along the heading now, negative when reversing; ``history``
        [n, F, 8], states divided by ``HISTORY_SCALE``, zero before ``first`` [n] (int64). With full context,
        where the spec names them: ``neighbors`` [n, M, 11], nearest first, zeros behind the last one;
        ``map`` and ``far_map`` [n, 3, 100, 100] in [-1, 1], 0 where nothing is known.

    Raises:
        ValueError: a target has no heading.
    """
    return complete([agent_frame_view(scene, targets, spec, context)])


def agent_frame_view(scene: Scene, targets: Ints, spec: FeatureSpec, context: Context) -> Prepared:
    """Return ``agent_frame_features`` with map patches that are not cut yet."""
    states = scene.states
    heading = states.heading[targets, -1]
    if np.isnan(heading).any():
        raise ValueError("an agent to be forecast in its own frame has no heading")
    features: dict[str, Floats | Float32s | Ints] = {
        "origin": states.position[targets, -1],
        "heading": heading,
        "speed": rotate(states.velocity[targets, -1], -heading)[:, 0].astype(np.float32),
        "history": _histories(states, targets).astype(np.float32),
        "first": states.first[targets],
    }
    views: dict[str, MapView] = {}
    if context is Context.FULL:
        if spec.neighbor_types:
            features["neighbors"] = _neighbors(scene, targets, spec.neighbor_types).astype(np.float32)
        if spec.uses_map:
            views["map"] = map_view(scene, targets, scene.patches, PATCHES["map"], OUTSIDE)
        if spec.far_map:
            views["far_map"] = map_view(scene, targets, scene.far_patches, PATCHES["far_map"], OUTSIDE)
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in features.items()}
    return Prepared(tensors, views)


def _histories(states: AgentStates, targets: Ints) -> Floats:
    """Return own states in the agents' frames: [n, F, 8], standardised, zero where not observed."""
    heading = states.heading[targets, -1][:, None]
    position = states.position[targets] - states.position[targets, -1:]
    parts = [
        rotate(position, -heading),
        rotate(states.velocity[targets], -heading),
        rotate(states.acceleration[targets], -heading),
        wrap_angle(states.heading[targets] - heading)[..., None],
        states.heading_rate[targets][..., None],
    ]
    histories: Floats = known_or_zero(np.concatenate(parts, axis=-1) / HISTORY_SCALE)
    return histories


def seen_in_agent_frame(scene: Scene, targets: Ints, types: Sequence[AgentType]) -> Bools:
    """Return which agents of the scene n agents can have as neighbours in ``agent_frame_features``: [n, N].

    Of more than ``NEIGHBORS`` only the nearest are taken.
    """
    others = np.flatnonzero([kind in types for kind in scene.types])
    mask = np.zeros((len(targets), len(scene.types)), dtype=np.bool_)
    mask[:, others] = _places(scene.states, targets, others)[2]
    return mask


def _places(states: AgentStates, targets: Ints, others: Ints) -> tuple[Floats, Floats, Bools]:
    """Return where n agents see m others, how far away, and whether as neighbours.

    Returns:
        [n, m, 2], m ahead and to the left; [n, m], m, NaN where not observed now; [n, m].
    """
    own = states.heading[targets, -1][:, None]
    place = rotate(states.position[others, -1][None] - states.position[targets, -1][:, None], -own)
    distance = np.hypot(place[..., 0], place[..., 1])
    with np.errstate(invalid="ignore"):
        seen: Bools = (distance <= NEIGHBOR_REACH_M) & (targets[:, None] != others[None])
    return place, distance, seen


def _neighbors(scene: Scene, targets: Ints, types: tuple[AgentType, ...]) -> Floats:
    """Return the neighbours of n agents: [n, M, 11]."""
    states = scene.states
    others = np.flatnonzero([kind in types for kind in scene.types])
    if not (len(others) and len(targets)):
        return np.zeros((len(targets), NEIGHBORS, NEIGHBOR_FEATURES))
    own = states.heading[targets, -1][:, None]
    place, distance, seen = _places(states, targets, others)

    def in_own_frame(vectors: Floats) -> Floats:
        return rotate(known_or_zero(vectors[others, -1])[None], -own)

    heading = states.heading[others, -1][None] - own
    known = np.isfinite(heading)
    kinds = [[scene.types[other] is kind for kind in _NEIGHBOR_KINDS] for other in others.tolist()]
    pairs = place.shape[:2]
    rows = np.concatenate(
        [
            place / NEIGHBOR_POSITION_SCALE,
            np.where(known, np.cos(heading), 0.0)[..., None],
            np.where(known, np.sin(heading), 0.0)[..., None],
            in_own_frame(states.velocity) / NEIGHBOR_VELOCITY_SCALE,
            in_own_frame(states.acceleration) / NEIGHBOR_ACCELERATION_SCALE,
            np.broadcast_to(np.array(kinds, float), (*pairs, len(_NEIGHBOR_KINDS))),
            np.ones((*pairs, 1)),
        ],
        axis=-1,
    )
    return nearest_rows(rows, distance, seen, NEIGHBORS)
