"""The folder of a run: its state, from which it can be resumed, and its log.

Parameters and optimiser are safetensors, the rest is JSON and CSV; there are no pickles.
"""

import csv
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

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
    """The progress of a run."""

    epoch: int
    """Epochs done."""
    step: int
    """Optimiser steps done."""
    best_epoch: int
    """Epoch (counted from 1) with the best validation score; 0: none yet."""
    best_score: float | None
    """Its score; smaller is better."""
    seconds: float
    """Seconds spent in training steps so far."""


def save_state(
    folder: Path,
    config: TrainingConfig,
    progress: Progress,
    learner: Learner,
    others: Mapping[str, nn.Module],
) -> None:
    """Write the state of a run. If this is interrupted, the state before is still there.

    Args:
        folder: folder of the run.
        config: settings of the run.
        progress: progress of the run.
        learner: networks and optimisers.
        others: modules beside the learner's, by names that none of the learner's has.
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
    # The progress names the file of its tensors and is replaced last, so the two always belong together
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
    """Restore a saved state (see ``save_state``); return None if there is none.

    Raises:
        TrainingError: the state is damaged, or belongs to a run with other settings (except more epochs).
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
    """Return all parameters of an optimiser."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def _parameter_names(learner: Learner) -> dict[torch.nn.Parameter, str]:
    """Return the names of all networks' parameters; no name is in two of them."""
    return {p: name for networks in learner.modules().values() for name, p in networks.named_parameters()}


def _check_same(file: Path, saved: Mapping[str, object], config: TrainingConfig, done: int) -> None:
    try:
        before = TrainingConfig.model_validate(saved)  # settings newer than the run have their defaults
    except ValidationError as error:
        names = ", ".join(".".join(map(str, one["loc"])) for one in error.errors())
        raise TrainingError(
            f"{file}: belongs to a run with settings that no longer exist: {names}"
        ) from error
    other = {name for name, value in config if name != "epochs" and getattr(before, name) != value}
    if before.epochs != config.epochs and done > _unaffected_epochs(before, config):
        other.add("epochs")
    if other:
        raise TrainingError(f"{file}: belongs to a run with other settings: {', '.join(sorted(other))}")


def _unaffected_epochs(before: TrainingConfig, now: TrainingConfig) -> float:
    """Return the number of epochs that do not depend on how many there are in all."""
    both = (before, now)
    cooling = min(each.epochs - each.cooldown_epochs if each.cooldown_epochs else math.inf for each in both)
    starts = {each.displacement_start for each in both} if now.displacement_weight else set()
    return min(cooling, *starts) if len(starts) > 1 else cooling


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors whose names begin so, by the rest of their names."""
    return {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}


class RunLog:
    """The figures of a run, a row an epoch, in ``log.csv``, and in TensorBoard where it is installed.

    Args:
        folder: folder of the run; TensorBoard's files go into ``tensorboard/`` there.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = folder / "log.csv"
        self._board = _summary_writer(folder / "tensorboard")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._board is not None:
            self._board.close()

    def add(self, progress: Progress, figures: dict[str, float]) -> None:
        """Add an epoch; rows of the same or later epochs, from an interrupted run, are replaced."""
        row = {"epoch": progress.epoch, "step": progress.step} | figures
        rows = [old for old in self.rows() if int(old["epoch"]) < progress.epoch]
        names = list(dict.fromkeys([*(name for old in rows for name in old), *row]))
        temporary = self._file.with_suffix(".new")
        with temporary.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, names, restval="")
            writer.writeheader()
            writer.writerows([*rows, row])
        temporary.replace(self._file)
        if self._board is not None:
            for name, value in figures.items():
                self._board.add_scalar(name, value, progress.epoch)
            self._board.flush()

    def rows(self) -> list[dict[str, str]]:
        """Return all rows, as text."""
        if not self._file.is_file():
            return []
        with self._file.open(newline="", encoding="utf-8") as stream:
            return list(csv.DictReader(stream))


def _summary_writer(folder: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 (an extra)
    except ImportError:
        return None
    return SummaryWriter(str(folder))
