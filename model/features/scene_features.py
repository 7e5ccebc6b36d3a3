"""The tensors that networks take of a scene; those of the ground frame are made here."""

import numpy as np
import torch

from model.arrays import Bools, Float32s, Floats, Ints
from model.features.agent_features import agent_frame_view, seen_in_agent_frame
from model.features.neighbor_boxes import neighbor_boxes, seen_as_boxes
from model.features.neighbors import edge_ramps, neighbor_sums
from model.features.spec import FeatureSpec, Frame
from model.features.standardization import HEADING, state_scale, state_vectors
from model.forecaster import Context, Features, Prepared, complete
from model.geometry import wrap_angle
from model.scenes.raster import NEAR, MapView, map_view
from model.scenes.scene import AgentStates, AgentType, Scene


def network_features(
    scene: Scene, targets: Ints, agent_type: AgentType, spec: FeatureSpec, context: Context
) -> Features:
    """Return the features of n agents of one type, in the frame of the network.

    Args:
        scene: the agents and their map.
        targets: [n], indices of agents of that type.
        agent_type: the type.
        spec: the features that the network takes.
        context: blind leaves out neighbours and map.

    Returns:
        Those of ``ground_frame_features`` or of ``model.features.agent_features.agent_frame_features``.
    """
    return complete([network_view(scene, targets, agent_type, spec, context)])


def network_view(
    scene: Scene, targets: Ints, agent_type: AgentType, spec: FeatureSpec, context: Context
) -> Prepared:
    """Return ``network_features`` with map patches that are not cut yet."""
    if spec.frame is Frame.AGENT:
        return agent_frame_view(scene, targets, spec, context)
    return _ground_frame_view(scene, targets, agent_type, spec, context)


def seen_neighbors(scene: Scene, targets: Ints, agent_type: AgentType, spec: FeatureSpec) -> Bools:
    """Return which agents of the scene can change the features of n agents of one type: [n, N].

    Args:
        scene: the agents.
        targets: [n], indices of agents of that type.
        agent_type: the type.
        spec: the features.
    """
    if spec.frame is Frame.AGENT:
        return seen_in_agent_frame(scene, targets, spec.neighbor_types)
    if spec.neighbor_boxes:
        return seen_as_boxes(scene, targets, spec.neighbor_types)
    seen = np.zeros((len(targets), len(scene.types)), dtype=np.bool_)
    for other in spec.neighbor_types:
        neighbors = np.flatnonzero(scene.of_type(other))
        seen[:, neighbors] = edge_ramps(scene.states, targets, agent_type, neighbors, other) > 0
    return seen


def ground_frame_features(
    scene: Scene, targets: Ints, agent_type: AgentType, spec: FeatureSpec, context: Context
) -> Features:
    """Return the features of n agents of one type in the ground frame.

    Returns:
        ``origin`` [n, 2] float64, position now, m; everything else float32: ``history`` [n, F, D],
        standardised own states, zero before ``first`` [n] (int64); ``velocity`` [n, 2], now, m/s.
        With full context also, where the spec names them: ``neighbors.<type>`` [n, F, D_type], summed
        standardised neighbour histories, and ``edge_mask`` [n], or instead of both ``neighbor_boxes``
        [n, S, 5] (``model.features.neighbor_boxes``); ``map`` [n, 3, 100, 100] in [-1, 1], zeros where
        there is no map.
    """
    return complete([_ground_frame_view(scene, targets, agent_type, spec, context)])


def _ground_frame_view(
    scene: Scene, targets: Ints, agent_type: AgentType, spec: FeatureSpec, context: Context
) -> Prepared:
    states = scene.states
    features: dict[str, Floats | Float32s | Ints] = {
        "origin": states.position[targets, -1],
        "velocity": states.velocity[targets, -1].astype(np.float32),
        "history": _own_history(states, targets, agent_type).astype(np.float32),
        "first": states.first[targets],
    }
    views: dict[str, MapView] = {}
    if context is Context.FULL:
        if spec.neighbor_types and spec.neighbor_boxes:
            features["neighbor_boxes"] = neighbor_boxes(scene, targets, spec.neighbor_types)
        elif spec.neighbor_types:
            features |= _neighbor_histories(scene, targets, agent_type, spec.neighbor_types)
        if spec.looks_at_map(agent_type):
            views["map"] = map_view(scene, targets, scene.patches, NEAR, outside=0.0)
    tensors = {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in features.items()}
    return Prepared(tensors, views)


def _own_history(states: AgentStates, targets: Ints, agent_type: AgentType) -> Floats:
    """Return standardised own states, zero where not observed: [n, F, D].

    Headings are continuous: they go on from the present one without jumps where they pass ±π.
    """
    history = state_vectors(states, agent_type)[targets]
    history[..., :2] -= states.position[targets, -1][:, None, :]
    if history.shape[-1] > HEADING:
        now = history[:, -1:, HEADING]
        history[..., HEADING] = now + wrap_angle(history[..., HEADING] - now)
    history /= state_scale(agent_type, agent_type)
    return np.nan_to_num(history, nan=0.0)


def _neighbor_histories(
    scene: Scene, targets: Ints, agent_type: AgentType, types: tuple[AgentType, ...]
) -> dict[str, Float32s]:
    """Return ``neighbors.<type>`` [n, F, D_type] for each type, and ``edge_mask`` [n]."""
    features: dict[str, Float32s] = {}
    mask = np.zeros(len(targets))
    for other in types:
        neighbors = np.flatnonzero(scene.of_type(other))
        edges = edge_ramps(scene.states, targets, agent_type, neighbors, other)
        sums = neighbor_sums(scene.states, targets, agent_type, neighbors, other, edges)
        features[f"neighbors.{other.value}"] = sums.astype(np.float32)
        mask += edges.sum(axis=1)  # one mask for the edges of all types
    features["edge_mask"] = np.minimum(mask, 1.0).astype(np.float32)
    return features
