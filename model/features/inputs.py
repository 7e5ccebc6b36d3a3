"""What the network of a configuration takes of a scene."""

import torch

from model.features.agent_features import agent_frame_features
from model.arrays import Ints
from model.features.scene_features import scene_features
from model.forecaster import Context, Features
from model.networks.config import AnyNetworkConfig, Frame, NetworkConfig
from model.scenes.scene import AgentType, Scene
from model.features.neighbor_boxes import surroundings


def network_features(
    scene: Scene, targets: Ints, agent_type: AgentType, config: AnyNetworkConfig, context: Context
) -> Features:
    """Features of n agents of one type.

    Returns:
        Those of ``model.features.scene_features.scene_features``; for a network of the agent's frame those of
        ``model.features.agent_features.agent_frame_features``; for CoverNet the former without neighbours' histories,
        but with ``surroundings`` [n, S, 5] float32 (``model.features.neighbor_boxes``) where it draws any and the
        context is full.
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
