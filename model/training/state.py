"""Where a run stands, on disk: parameters and optimiser as safetensors, the rest as JSON. No pickles."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from model.training.config import TrainingConfig, TrainingError

_TENSORS = "state.safetensors"
_PROGRESS = "state.json"


@dataclass(frozen=True)
class Progress:
    """How far a run is."""

    epoch: int
    """Epochs done."""
    step: int
    """Optimiser steps done."""
    best_epoch: int
    """The epoch (counted from 1) of the best validation; 0: none yet."""
    best_score: float | None
    """Its score, the smaller the better."""
    seconds: float
    """Spent in training steps so far."""


def save_state(
    folder: Path,
    config: TrainingConfig,
    progress: Progress,
    networks: torch.nn.Module,
    optimizer: torch.optim.Optimizer,
) -> None:
    """Writes the state; whoever is interrupted in it finds the one before."""
    names = [name for name, _ in networks.named_parameters()]
    tensors: dict[str, Tensor] = {f"network.{k}": v for k, v in networks.state_dict().items()}
    for index, moments in optimizer.state_dict()["state"].items():
        for name, value in moments.items():
            tensors[f"optimizer.{names[index]}.{name}"] = value
    folder.mkdir(parents=True, exist_ok=True)
    # The progress names its tensors' file, and is replaced last: the pair is never of two states
    file = f"{progress.epoch:04d}.{_TENSORS}"
    save_file({name: t.detach().cpu().contiguous() for name, t in tensors.items()}, folder / file)
    document = {"config": config.model_dump(mode="json"), "progress": asdict(progress), "tensors": file}
    temporary = folder / f"{_PROGRESS}.new"
    temporary.write_text(json.dumps(document, indent=1), encoding="utf-8")
    temporary.replace(folder / _PROGRESS)
    for old in folder.glob(f"*.{_TENSORS}"):
        if old.name != file:
            old.unlink()


def load_state(
    folder: Path, config: TrainingConfig, networks: torch.nn.Module, optimizer: torch.optim.Optimizer
) -> Progress | None:
    """Puts a saved state back; None where there is none.

    Raises:
        TrainingError: it is damaged, or of a run with other settings (more epochs are no other setting).
    """
    file = folder / _PROGRESS
    if not file.is_file():
        return None
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        tensors = load_file(folder / document["tensors"])
        progress = Progress(**document["progress"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrainingError(f"{file}: cannot be resumed: {error}") from error
    _check_same(file, document["config"], config)
    device = next(networks.parameters()).device
    networks.load_state_dict(_under("network.", tensors))
    moments = _under("optimizer.", tensors)
    state = optimizer.state_dict()
    state["state"] = {}
    for index, (name, _) in enumerate(networks.named_parameters()):
        own = _under(f"{name}.", moments)
        if own:
            state["state"][index] = {key: t if key == "step" else t.to(device) for key, t in own.items()}
    optimizer.load_state_dict(state)
    return progress


def _check_same(file: Path, saved: Mapping[str, object], config: TrainingConfig) -> None:
    now = config.model_dump(mode="json")
    other = sorted(k for k in now if k != "epochs" and saved.get(k) != now[k])
    if other:
        raise TrainingError(f"{file}: is of a run with other settings: {', '.join(other)}")


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
