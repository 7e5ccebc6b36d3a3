"""From a scene to the tensors that the networks take."""

import numpy as np
import torch

from model.arrays import Float32s, Floats, Ints
from model.features.agent_features import agent_frame_features
from model.features.neighbor_boxes import surroundings
from model.features.neighbors import edge_ramps, neighbor_sums
from model.features.standardization import HEADING, state_scale, state_vectors
from model.forecaster import Context, Features
from model.geometry import wrap_angle
from model.networks.config import AnyNetworkConfig, Frame, NetworkConfig
from model.scenes.raster import PATCH_SIZE, cut_patches
from model.scenes.scene import AgentStates, AgentType, Scene


def scene_features(
    scene: Scene, targets: Ints, agent_type: AgentType, config: NetworkConfig, context: Context
) -> Features:
    """Features of n agents of one type.

    Returns:
        ``origin`` [n, 2] float64, position now, m; everything else float32: ``history`` [n, F, D],
        standardised own states, zero before ``first`` [n] (int64); ``velocity`` [n, 2], now, m/s; with
        full context also, where the network uses them, ``neighbors.<type>`` [n, F, D_type], summed
        standardised neighbour histories, ``edge_mask`` [n], and ``map`` [n, 3, 100, 100] in [-1, 1],
        zeros where there is no map.
    """
    states = scene.states
    features: dict[str, Floats | Float32s | Ints] = {
        "origin": states.position[targets, -1],
        "velocity": states.velocity[targets, -1].astype(np.float32),
        "history": _own_history(states, targets, agent_type).astype(np.float32),
        "first": states.first[targets],
    }
    if context is Context.FULL:
        if config.neighbor_types:
            mask = np.zeros(len(targets))
            for other in config.neighbor_types:
                neighbors = np.flatnonzero(scene.of_type(other))
                edges = edge_ramps(states, targets, agent_type, neighbors, other)
                sums = neighbor_sums(states, targets, agent_type, neighbors, other, edges)
                features[f"neighbors.{other.value}"] = sums.astype(np.float32)
                mask += edges.sum(axis=1)  # over every type: one mask for all of an agent's edges
            features["edge_mask"] = np.minimum(mask, 1.0).astype(np.float32)
        if config.looks_at_map(agent_type):
            features["map"] = _maps(scene, targets)
    return {name: torch.from_numpy(np.ascontiguousarray(values)) for name, values in features.items()}


def _own_history(states: AgentStates, targets: Ints, agent_type: AgentType) -> Floats:
    """[n, F, D], standardised, zero where not observed; headings run on from the present one, without
    jumps where they pass ±π."""
    history = state_vectors(states, agent_type)[targets]
    history[..., :2] -= states.position[targets, -1][:, None, :]
    if history.shape[-1] > HEADING:
        now = history[:, -1:, HEADING]
        history[..., HEADING] = now + wrap_angle(history[..., HEADING] - now)
    history /= state_scale(agent_type, agent_type)
    return np.nan_to_num(history, nan=0.0)


def _maps(scene: Scene, targets: Ints) -> Float32s:
    """[n, 3, 100, 100] in [-1, 1]: absent −1, present 1; 0, midway, where nothing is known."""
    maps = np.zeros((len(targets), 3, PATCH_SIZE, PATCH_SIZE), dtype=np.float32)
    own = np.array([int(target) in scene.patches for target in targets], dtype=np.bool_)
    cut = ~own
    if scene.raster is not None and cut.any():
        states, seen = scene.states, targets[cut]
        maps[cut] = 2 * cut_patches(scene.raster, states.position[seen, -1], states.heading[seen, -1]) - 1
    for row in np.flatnonzero(own):
        maps[row] = 2 * scene.patches[int(targets[row])].astype(np.float32) - 1
    return maps


def network_features(
    scene: Scene, targets: Ints, agent_type: AgentType, config: AnyNetworkConfig, context: Context
) -> Features:
    """Features of n agents of one type.

    Returns:
        Those of ``model.features.scene_features.scene_features``; for a network of the agent's frame those of
        ``model.features.agent_features.agent_frame_features``; for CoverNet the former without neighbours'
        histories, but with ``surroundings`` [n, S, 5] float32 (``model.features.neighbor_boxes``) where it
        draws any and the context is full.
    """
    if isinstance(config, NetworkConfig) and config.frame is Frame.AGENT:
        return agent_frame_features(scene, targets, config, context)
    if isinstance(config, NetworkConfig):
        return scene_features(scene, targets, agent_type, config, context)
    alone = NetworkConfig(neighbor_types=(), uses_map=config.uses_map)
    features = scene_features(scene, targets, agent_type, alone, context)
    if config.neighbor_types and context is Context.FULL:
        features["surroundings"] = torch.from_numpy(surroundings(scene, targets, config.neighbor_types))
    return features
