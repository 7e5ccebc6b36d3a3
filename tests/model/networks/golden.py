"""Features from the golden inputs, where every neighbour is connected with an edge ramp of 1."""

from pathlib import Path

import numpy as np
import torch

from model.features.standardization import state_scale
from model.forecaster import Features
from model.scenes.scene import AgentType

TYPES = (AgentType.VEHICLE, AgentType.PEDESTRIAN)


def golden_features(file: Path, kind: AgentType) -> Features:
    """Features of the agents in a golden input file."""
    inputs = np.load(file)
    history = inputs["history"]
    agents = len(history)
    own = history.copy()
    own[..., :2] -= history[:, -1:, :2]
    features = {
        "origin": torch.from_numpy(history[:, -1, :2].copy()),
        "velocity": torch.from_numpy(history[:, -1, 2:4].astype(np.float32)),
        "history": torch.from_numpy(np.nan_to_num(own / state_scale(kind, kind)).astype(np.float32)),
        "first": torch.from_numpy(inputs["first_history_index"]),
        "map": torch.from_numpy(inputs["map"].astype(np.float32) * 2 - 1),
    }
    connected = np.zeros(agents)
    for other in TYPES:
        count, neighbors = inputs[f"neighbors_{other.value}_count"], inputs[f"neighbors_{other.value}"]
        owner = np.repeat(np.arange(agents), count)
        common = min(history.shape[2], neighbors.shape[2])
        relative = neighbors.copy()
        relative[..., :common] -= history[owner, -1:, :common]
        sums = np.zeros((agents, *neighbors.shape[1:]))
        np.add.at(sums, owner, relative / state_scale(kind, other))
        features[f"neighbors.{other.value}"] = torch.from_numpy(sums.astype(np.float32))
        connected += count
    features["edge_mask"] = torch.from_numpy(np.minimum(connected, 1).astype(np.float32))
    return features


def double(features: Features) -> Features:
    """Return the features in float64."""
    return {name: t.double() if t.is_floating_point() else t for name, t in features.items()}
