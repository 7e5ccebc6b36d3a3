"""Where a run stands, on disk: parameters and optimiser as safetensors, the rest as JSON. No pickles."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from pydantic import ValidationError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from model.training.config import TrainingConfig, TrainingError
from model.training.learner import Learner

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
    learner: Learner,
    others: Mapping[str, nn.Module],
) -> None:
    """Writes the state; whoever is interrupted in it finds the one before.

    Args:
        folder: of the run.
        config: its settings.
        progress: where it stands.
        learner: networks and optimisers.
        others: modules beside the learner's, by names that none of its has.
    """
    tensors: dict[str, Tensor] = {
        f"{module}.{name}": tensor
        for module, networks in {**learner.modules(), **others}.items()
        for name, tensor in networks.state_dict().items()
    }
    names = _parameter_names(learner)
    for name, optimizer in learner.optimizers.items():
        for parameter in _parameters(optimizer):
            moments: dict[str, Tensor] = optimizer.state.get(parameter, {})
            tensors |= {f"{name}.{names[parameter]}.{moment}": value for moment, value in moments.items()}
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
    folder: Path, config: TrainingConfig, learner: Learner, others: Mapping[str, nn.Module]
) -> Progress | None:
    """Puts a saved state back (see ``save_state``); None where there is none.

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
    _check_same(file, document["config"], config, progress.epoch)
    for name, networks in {**learner.modules(), **others}.items():
        networks.load_state_dict(_under(f"{name}.", tensors))
    names = _parameter_names(learner)
    for name, optimizer in learner.optimizers.items():
        moments = _under(f"{name}.", tensors)
        for parameter in _parameters(optimizer):
            own = _under(f"{names[parameter]}.", moments)
            if own:
                optimizer.state[parameter] = {
                    key: t if key == "step" else t.to(parameter.device) for key, t in own.items()
                }
    return progress


def _parameters(optimizer: torch.optim.Optimizer) -> list[torch.nn.Parameter]:
    """All that an optimiser changes."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _parameter_names(learner: Learner) -> dict[torch.nn.Parameter, str]:
    """Of all networks; no name is in two of them."""
    return {p: name for networks in learner.modules().values() for name, p in networks.named_parameters()}


def _check_same(file: Path, saved: Mapping[str, object], config: TrainingConfig, done: int) -> None:
    try:
        before = TrainingConfig.model_validate(saved)  # what is newer than the run has its default
    except ValidationError as error:
        names = ", ".join(".".join(map(str, one["loc"])) for one in error.errors())
        raise TrainingError(f"{file}: is of a run with settings that there are no more: {names}") from error
    other = {name for name, value in config if name != "epochs" and getattr(before, name) != value}
    if before.epochs != config.epochs and done > _settled(before, config):
        other.add("epochs")
    if other:
        raise TrainingError(f"{file}: is of a run with other settings: {', '.join(sorted(other))}")


def _settled(before: TrainingConfig, now: TrainingConfig) -> float:
    """How many epochs may have been done before it makes a difference of how many they are."""
    both = (before, now)
    cooling = min(each.epochs - each.cooldown_epochs if each.cooldown_epochs else math.inf for each in both)
    apart = {each.epochs_apart for each in both} if now.displacement_weight else set()
    return min(cooling, *apart) if len(apart) > 1 else cooling


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
