"""From a scene to the tensors that a network of the agent's frame takes."""

from collections.abc import Mapping

import numpy as np
import torch

from model.arrays import Bools, Bytes, Float32s, Floats, Ints
from model.forecaster import Context, Features
from model.geometry import rotate, wrap_angle
from model.networks.config import NetworkConfig
from model.scenes.raster import FAR, NEAR, PatchGeometry, cut_patches
from model.scenes.scene import AgentStates, AgentType, Scene

HISTORY_SCALE = np.array([20.0, 5.0, 15.0, 5.0, 3.0, 3.0, 0.5, 0.5])
"""What x, y, vx, vy, ax, ay, heading and heading rate of a history are divided by (m, m/s, m/s², rad, rad/s).
Across the agent everything is smaller than along it."""
NEIGHBORS = 16
"""M, neighbours of an agent at most; the nearest count."""
NEIGHBOR_REACH_M = 60.0
"""m; who is farther away now is no neighbour."""
NEIGHBOR_POSITION_SCALE = 30.0
NEIGHBOR_VELOCITY_SCALE = 15.0
NEIGHBOR_ACCELERATION_SCALE = 4.0
NEIGHBOR_FEATURES = 11
"""Numbers that tell a neighbour: x, y, cosine and sine of its heading (zeros where unknown), vx, vy, ax, ay,
all in the agent's frame, whether it is a vehicle, whether it is a pedestrian, and 1 (0 where nobody is)."""


def agent_frame_features(scene: Scene, targets: Ints, config: NetworkConfig, context: Context) -> Features:
    """Return features of n vehicles, each in its own frame: origin at its position now, x along its heading.

    Returns:
        ``origin`` [n, 2] and ``heading`` [n], both float64: the frame, m and rad in the ground frame.
        All else float32: ``speed`` [n], m/s along the heading now, negative when reversing; ``history``
        [n, F, 8], states divided by ``HISTORY_SCALE``, zero before ``first`` [n] (int64). With full context,
        where the network uses them, ``neighbors`` [n, M, 11], nearest first, zeros behind the last one;
        ``map`` and ``far_map`` [n, 3, 100, 100] in [-1, 1], 0 where nothing is known.

    Raises:
        ValueError: a target has no heading.
    """
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
    if context is Context.FULL:
        if config.neighbor_types:
            features["neighbors"] = _neighbors(scene, targets, config.neighbor_types).astype(np.float32)
        if config.uses_map:
            features["map"] = _maps(scene, targets, scene.patches, NEAR)
        if config.far_map:
            features["far_map"] = _maps(scene, targets, scene.far_patches, FAR)
    return {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in features.items()}


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
    histories: Floats = np.nan_to_num(np.concatenate(parts, axis=-1) / HISTORY_SCALE, nan=0.0)
    return histories


def _neighbors(scene: Scene, targets: Ints, types: tuple[AgentType, ...]) -> Floats:
    """Return the neighbours of n agents: [n, M, 11]."""
    states = scene.states
    result = np.zeros((len(targets), NEIGHBORS, NEIGHBOR_FEATURES))
    others = np.flatnonzero([kind in types for kind in scene.types])
    if not (len(others) and len(targets)):
        return result
    own = states.heading[targets, -1][:, None]
    place = rotate(states.position[others, -1][None] - states.position[targets, -1][:, None], -own)
    distance = np.hypot(place[..., 0], place[..., 1])  # NaN where not observed now
    with np.errstate(invalid="ignore"):
        seen: Bools = (distance <= NEIGHBOR_REACH_M) & (targets[:, None] != others[None])
    nearest = np.argsort(np.where(seen, distance, np.inf), axis=1, kind="stable")[:, :NEIGHBORS]

    def turned(vectors: Floats) -> Floats:
        return rotate(np.nan_to_num(vectors[others, -1])[None], -own)

    turn = states.heading[others, -1][None] - own
    told = np.isfinite(turn)
    kinds = np.array([[scene.types[other] is kind for kind in _KINDS] for other in others.tolist()], float)
    shape = place.shape[:2]
    told_all = np.concatenate(
        [
            place / NEIGHBOR_POSITION_SCALE,
            np.where(told, np.cos(turn), 0.0)[..., None],
            np.where(told, np.sin(turn), 0.0)[..., None],
            turned(states.velocity) / NEIGHBOR_VELOCITY_SCALE,
            turned(states.acceleration) / NEIGHBOR_ACCELERATION_SCALE,
            np.broadcast_to(kinds, (*shape, len(_KINDS))),
            np.ones((*shape, 1)),
        ],
        axis=-1,
    )
    picked = np.take_along_axis(told_all, nearest[..., None], axis=1)
    kept = np.take_along_axis(seen, nearest, axis=1)[..., None]
    result[:, : nearest.shape[1]] = np.where(kept, picked, 0.0)
    return result


_KINDS = (AgentType.VEHICLE, AgentType.PEDESTRIAN)


def _maps(
    scene: Scene, targets: Ints, patches: Mapping[int, Bytes | Float32s], geometry: PatchGeometry
) -> Float32s:
    """Return maps of n agents: [n, 3, S, S]: absent −1, present 1; 0 where nothing is known, as outside the
    raster."""
    maps = np.zeros((len(targets), 3, geometry.size, geometry.size), dtype=np.float32)
    given = np.array([int(target) in patches for target in targets], dtype=np.bool_)
    cut = ~given
    if scene.raster is not None and cut.any():
        states, seen = scene.states, targets[cut]
        position, heading = states.position[seen, -1], states.heading[seen, -1]
        maps[cut] = 2 * cut_patches(scene.raster, position, heading, geometry, outside=0.5) - 1
    for row in np.flatnonzero(given):
        maps[row] = 2 * patches[int(targets[row])].astype(np.float32) - 1
    return maps
