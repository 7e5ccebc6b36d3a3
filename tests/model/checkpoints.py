"""Checkpoints of small numbers for tests."""

import json
import shutil
from pathlib import Path

import torch
from torch import Tensor

import model
from model.forecaster import ModelInfo, Protocol
from model.networks.config import AnyNetworkConfig, NetworkConfig
from model.networks.forecaster import CvaeNetworks


def network() -> NetworkConfig:
    """Vehicles only, with map and neighbours."""
    return NetworkConfig()


def info(
    config: AnyNetworkConfig | None = None,
    name: str = "some-model",
    version: str = "1.0.0",
    protocol: Protocol = Protocol.CAUSAL,
) -> ModelInfo:
    """Return the facts about a model that fit its network."""
    config = config or network()
    return ModelInfo(
        name=name,
        version=version,
        protocol=protocol,
        description="For tests.",
        agent_types=config.agent_types,
        context_types=config.neighbor_types,
        history_frames=5,
        modes=config.modes,
        uses_map=config.uses_map,
        uses_neighbors=bool(config.neighbor_types),
        supports_blind=config.supports_blind,
        license="none",
    )


def tensors(config: NetworkConfig | None = None) -> dict[str, Tensor]:
    """Parameters of the network, the same every time."""
    with torch.device("meta"):
        shapes = CvaeNetworks(config or network()).state_dict()
    generator = torch.Generator().manual_seed(0)
    return {name: 0.1 * torch.randn(shape.shape, generator=generator) for name, shape in shapes.items()}


def copy_bundled(folder: Path, checkpoint: str = "cab", version: str | None = None) -> Path:
    """Copy a bundled checkpoint, under another version if one is given.

    Args:
        folder: the new folder.
        checkpoint: name of the bundled folder.
        version: the version of the copy; None: the original's.
    """
    source = Path(next(iter(model.__path__))) / "checkpoints" / checkpoint
    shutil.copytree(source, folder)
    if version is not None:
        config = json.loads((folder / "config.json").read_text())
        config["info"]["version"] = version
        (folder / "config.json").write_text(json.dumps(config))
    return folder
