"""Conversion of published Trajectron++ checkpoints for nuScenes.

They are from github.com/StanfordASL/Trajectron-plus-plus.
"""

import json
import shutil
from pathlib import Path
from typing import Any, Final

import torch

from model.checkpoint import save_checkpoint
from model.convert.errors import ConversionError
from model.convert.tensor_names import rename
from model.convert.torch_legacy import read_parameters
from model.forecaster import ModelInfo, Protocol
from model.networks.config import BlindContext, NetworkConfig
from model.networks.forecaster import CvaeForecaster
from model.scenes.scene import AgentType

_REQUIRED: Final[dict[str, Any]] = {
    "K": 25,
    "N": 1,
    "GMM_components": 1,
    "enc_rnn_dim_edge": 32,
    "enc_rnn_dim_edge_influence": 32,
    "enc_rnn_dim_history": 32,
    "enc_rnn_dim_future": 32,
    "dec_rnn_dim": 128,
    "p_z_x_MLP_dims": 32,
    "q_z_xy_MLP_dims": None,
    "edge_encoding": True,
    "edge_state_combine_method": "sum",
    "edge_influence_combine_method": "attention",
    "edge_addition_filter": [0.25, 0.5, 0.75, 1.0],
    "edge_removal_filter": [1.0, 0.0],
    "dynamic_edges": "yes",
    "override_attention_radius": [],
    "incl_robot_node": False,
    "use_map_encoding": True,
    "map_encoder.VEHICLE.heading_state_index": 6,
    "map_encoder.VEHICLE.patch_size": [50, 10, 50, 90],
    "map_encoder.VEHICLE.map_channels": 3,
    "map_encoder.VEHICLE.hidden_channels": [10, 20, 10, 1],
    "map_encoder.VEHICLE.output_size": 32,
    "map_encoder.VEHICLE.masks": [5, 5, 5, 3],
    "map_encoder.VEHICLE.strides": [2, 2, 1, 1],
    "dynamic.VEHICLE.name": "Unicycle",
    "dynamic.VEHICLE.distribution": True,
    "dynamic.PEDESTRIAN.name": "SingleIntegrator",
    "dynamic.PEDESTRIAN.distribution": True,
    "state.VEHICLE": {
        "position": ["x", "y"],
        "velocity": ["x", "y"],
        "acceleration": ["x", "y"],
        "heading": ["°", "d°"],
    },
    "state.PEDESTRIAN": {"position": ["x", "y"], "velocity": ["x", "y"], "acceleration": ["x", "y"]},
    "pred_state.VEHICLE": {"position": ["x", "y"]},
    "pred_state.PEDESTRIAN": {"position": ["x", "y"]},
}
"""Settings by path within config.json that are fixed in our network."""

_MISSING: Final = object()

MAX_HISTORY_LENGTH = 64
"""Maximum number of frames before now."""

_TYPES = (AgentType.VEHICLE, AgentType.PEDESTRIAN)

_CARD = """# Trajectron++ (published weights, int_ee_me, epoch {checkpoint})

The weights that the authors of Trajectron++ published for nuScenes (Salzmann, Ivanovic, Chakravarty and
Pavone: "Trajectron++: Dynamically-Feasible Trajectory Forecasting With Heterogeneous Data", ECCV 2020), with
interactions, edge encoding and map encoding, converted tensor by tensor; nothing was trained.

- **Protocol: paper.** The model was trained on velocities and accelerations by central differences over whole
  tracks: the state "now" contains the next positions. On causal inputs, all that a live service has, it is
  markedly worse than its published figures. Use it to reproduce tables, not to drive.
- Forecasts vehicles and pedestrians, {frames} frames of history at 2 Hz, 25 modes, 6 s (trained on 3 s).
- Looks at neighbours (vehicles, pedestrians) and, for vehicles, the map. No blind forecast.
- Licence: weights MIT (Stanford Autonomous Systems Lab, see LICENSE where it is); trained on nuScenes, whose
  terms of use allow non-commercial use only.
"""


def convert_trajectron(source: Path, checkpoint: int, out: Path) -> None:
    """Convert a published Trajectron++ checkpoint for nuScenes.

    Nothing that its pickle names is executed.

    Args:
        source: folder with config.json, model_registrar-<checkpoint>.pt and, optionally, LICENSE.
        checkpoint: the epoch.
        out: folder of the new checkpoint, created if missing.

    Raises:
        UnsafePickleError: the pickle names anything not known to be harmless.
        ConversionError: a file is missing or damaged, or the network is not one that this package has.
    """
    if out.resolve() == source.resolve():
        raise ConversionError(f"{out}: the new checkpoint would overwrite its source")
    frames = _history_frames(source / "config.json")
    file = source / f"model_registrar-{checkpoint}.pt"
    tensors = rename({name: torch.from_numpy(array) for name, array in read_parameters(file).items()})
    network = NetworkConfig(agent_types=_TYPES, neighbor_types=_TYPES, uses_map=True, blind=BlindContext.NONE)
    info = _info(checkpoint, frames, network)
    try:
        CvaeForecaster(info, network, tensors)
    except ValueError as error:
        raise ConversionError(f"{file}: {error}") from error
    if not all(tensor.isfinite().all() for tensor in tensors.values()):
        raise ConversionError(f"{file}: not all parameters are finite")
    save_checkpoint(out, info, network, tensors, _CARD.format(checkpoint=checkpoint, frames=frames))
    if (source / "LICENSE").is_file():
        shutil.copyfile(source / "LICENSE", out / "LICENSE")


def _info(checkpoint: int, frames: int, network: NetworkConfig) -> ModelInfo:
    return ModelInfo(
        name="trajectron",
        version=f"0.{checkpoint}.0",
        protocol=Protocol.PAPER,
        description="Trajectron++ with the authors' published weights for nuScenes.",
        agent_types=network.agent_types,
        context_types=network.neighbor_types,
        history_frames=frames,
        modes=network.modes,
        uses_map=True,
        uses_neighbors=True,
        supports_blind=False,
        trained_on=f"nuScenes (published Trajectron++ weights, int_ee_me, epoch {checkpoint})",
        license="MIT (weights); trained on nuScenes: non-commercial",
    )


def _history_frames(file: Path) -> int:
    """Check that the settings describe our network, and return the frames of history, now included."""
    try:
        settings = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConversionError(f"{file}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ConversionError(f"{file}: not JSON: {error}") from error
    faults = [
        f"{path} is {_told(given)}, not {required!r}"
        for path, required in _REQUIRED.items()
        if (given := _setting(settings, path)) != required
    ]
    if faults:
        raise ConversionError(f"{file}: not a network that this package has: {'; '.join(faults)}")
    history = _setting(settings, "maximum_history_length")
    if type(history) is not int or not 1 <= history <= MAX_HISTORY_LENGTH:
        raise ConversionError(
            f"{file}: maximum_history_length is {history!r}, not in 1 … {MAX_HISTORY_LENGTH}"
        )
    return history + 1


def _setting(settings: Any, path: str) -> Any:
    """Return the setting at a path of dotted keys, or ``_MISSING``."""
    for key in path.split("."):
        if not isinstance(settings, dict) or key not in settings:
            return _MISSING
        settings = settings[key]
    return settings


def _told(setting: Any) -> str:
    return "missing" if setting is _MISSING else repr(setting)
