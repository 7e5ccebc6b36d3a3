"""A trained model in a folder: ``config.json``, ``model.safetensors`` and ``README.md``, its model card.

A checkpoint contains no code, and loading one executes none (safetensors, not pickles).
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import safetensors.torch
from packaging.version import InvalidVersion, Version
from pydantic import AfterValidator, BaseModel, ConfigDict, ValidationError, model_validator
from safetensors import SafetensorError
from torch import Tensor

from model.forecaster import Forecaster, ModelInfo
from model.networks.config import AnyNetworkConfig, CoverNetConfig
from model.networks.forecaster import CoverNetForecaster, CvaeForecaster

FORMAT_VERSION = 1
"""Version of the folder's layout and of config.json; a release reads exactly one version."""
CONFIG_FILE = "config.json"
TENSORS_FILE = "model.safetensors"
CARD_FILE = "README.md"


class CheckpointError(Exception):
    """An unusable checkpoint: the file, and its fault."""

    def __init__(self, file: Path, fault: str) -> None:
        super().__init__(f"{file}: {fault}")
        self.file = file
        self.fault = fault


def _format_version(value: int) -> int:
    if value != FORMAT_VERSION:
        raise ValueError(f"format version {value} is not known; this release reads version {FORMAT_VERSION}")
    return value


class CheckpointConfig(BaseModel):
    """The content of config.json."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format_version: Annotated[int, AfterValidator(_format_version)]
    info: ModelInfo
    network: AnyNetworkConfig
    tensors_sha256: str
    """Checksum of model.safetensors, so that files of two checkpoints are never mixed."""

    @model_validator(mode="after")
    def _version_is_ordered(self) -> "CheckpointConfig":
        try:
            Version(self.info.version)
        except InvalidVersion as error:
            raise ValueError(f"info.version {self.info.version!r} is not a version (PEP 440)") from error
        return self

    @model_validator(mode="after")
    def _info_tells_the_network(self) -> "CheckpointConfig":
        info, network = self.info, self.network
        pairs: dict[str, tuple[object, object]] = {
            "agent_types": (set(info.agent_types), set(network.agent_types)),
            "context_types": (set(info.context_types), set(network.neighbor_types)),
            "modes": (info.modes, network.modes),
            "uses_map": (info.uses_map, network.uses_map),
            "uses_neighbors": (info.uses_neighbors, bool(network.neighbor_types)),
            "supports_blind": (info.supports_blind, network.supports_blind),
        }
        if isinstance(network, CoverNetConfig):
            pairs["steps"] = (info.steps, network.steps)
        wrong = [name for name, (told, true) in pairs.items() if told != true]
        if wrong:
            raise ValueError(f"info does not fit the network in {', '.join(wrong)}")
        return self


@dataclass(frozen=True)
class Checkpoint:
    """A loaded checkpoint. Its tensors are finite, but not yet checked against the network."""

    folder: Path
    info: ModelInfo
    network: AnyNetworkConfig
    tensors: Mapping[str, Tensor]

    def forecaster(self) -> Forecaster:
        """Return the model.

        Raises:
            CheckpointError: tensors are missing, unexpected or of the wrong shape.
        """
        try:
            if isinstance(self.network, CoverNetConfig):
                return CoverNetForecaster(self.info, self.network, self.tensors)
            return CvaeForecaster(self.info, self.network, self.tensors)
        except ValueError as error:
            raise CheckpointError(self.folder / TENSORS_FILE, str(error)) from error


def save_checkpoint(
    folder: Path, info: ModelInfo, network_config: AnyNetworkConfig, tensors: Mapping[str, Tensor], card: str
) -> None:
    """Write a checkpoint, replacing its three files if they exist.

    Args:
        folder: the folder, created if missing.
        info: facts about the model.
        network_config: configuration of the network.
        tensors: parameters of the network by name.
        card: model card, Markdown.

    Raises:
        CheckpointError: a tensor is not finite.
        ValueError: info does not fit the network, or its version is invalid.
    """
    _check_finite(folder / TENSORS_FILE, tensors)
    data = safetensors.torch.save({name: tensor.contiguous() for name, tensor in tensors.items()})
    config = CheckpointConfig(
        format_version=FORMAT_VERSION,
        info=info,
        network=network_config,
        tensors_sha256=hashlib.sha256(data).hexdigest(),
    )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / TENSORS_FILE).write_bytes(data)
    (folder / CARD_FILE).write_text(card, encoding="utf-8")
    (folder / CONFIG_FILE).write_text(config.model_dump_json(indent=2) + "\n", encoding="utf-8")


def load_checkpoint(folder: Path) -> Checkpoint:
    """Read a checkpoint, on the CPU.

    Raises:
        CheckpointError: a file is missing, damaged or of an unknown format.
    """
    config = _read_config(folder / CONFIG_FILE)
    file = folder / TENSORS_FILE
    data = _read(file)
    try:
        tensors = safetensors.torch.load(data)
    except (SafetensorError, KeyError, ValueError, RuntimeError) as error:  # the last three: unknown types
        raise CheckpointError(file, f"not a whole safetensors file: {error}") from error
    if hashlib.sha256(data).hexdigest() != config.tensors_sha256:
        raise CheckpointError(file, f"not the file that {CONFIG_FILE} was written with: its SHA-256 differs")
    _check_finite(file, tensors)
    return Checkpoint(folder, config.info, config.network, tensors)


def _read_config(file: Path) -> CheckpointConfig:
    try:
        content = json.loads(_read(file))
    except (ValueError, RecursionError) as error:
        raise CheckpointError(file, f"not JSON: {error}") from error
    version = content.get("format_version") if isinstance(content, dict) else None
    try:
        # The version first: fields of another version are not the fault to report
        if isinstance(version, int):
            _format_version(version)
        return CheckpointConfig.model_validate(content)
    except ValidationError as error:
        faults = [
            f"{'.'.join(map(str, fault['loc']))}: {fault['msg']}".lstrip(": ") for fault in error.errors()
        ]
        raise CheckpointError(file, "; ".join(faults)) from error
    except ValueError as error:
        raise CheckpointError(file, str(error)) from error


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except FileNotFoundError as error:
        raise CheckpointError(file, "there is no such file") from error
    except OSError as error:
        raise CheckpointError(file, f"cannot be read: {error.strerror}") from error


def _check_finite(file: Path, tensors: Mapping[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.float().isfinite().all():
            raise CheckpointError(file, f"{name} holds numbers that are not finite")
