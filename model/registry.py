"""The models that can forecast, by name and version."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from packaging.version import InvalidVersion, Version

if TYPE_CHECKING:
    from model.checkpoint import Checkpoint
    from model.forecaster import Forecaster, ModelInfo

# Models are imported when a registry is made, so that importing this module does not load torch.

_BASELINES = (
    "model.baselines.physics",
    "model.baselines.kalman",
)
"""Modules of the models that need no checkpoint. Each has a function ``baselines()`` that returns them."""


class UnknownModelError(LookupError):
    """An unknown model; the message lists the available ones.

    Args:
        name: the requested name.
        available: names of the models in the registry.
        passed_over: models of that name that were not loaded because they are of the paper protocol.
    """

    def __init__(self, name: str, available: Sequence[str], passed_over: Sequence[str] = ()) -> None:
        text = f"there is no model {name!r}; there are {', '.join(available) or 'none'}"
        if passed_over:
            text += f" (the paper protocol was not allowed, so {', '.join(passed_over)} was not loaded)"
        super().__init__(text)
        self.name = name
        self.available = tuple(available)


class DuplicateModelError(ValueError):
    """Two models of the same name and version."""


class Registry:
    """Models by ``name@version``; a name alone means its newest version of the causal protocol.

    Args:
        forecasters: the models.
        passed_over: models that were found but not loaded because of their protocol.

    Raises:
        DuplicateModelError: two models have the same name and version.
    """

    def __init__(self, forecasters: Iterable[Forecaster], passed_over: Iterable[ModelInfo] = ()) -> None:
        self.passed_over = tuple(passed_over)
        self._models: dict[str, dict[Version, Forecaster]] = {}
        for forecaster in forecasters:
            info = forecaster.info
            versions = self._models.setdefault(info.name, {})
            if (version := Version(info.version)) in versions:
                raise DuplicateModelError(f"there are two models {info.full_name}")
            versions[version] = forecaster

    @classmethod
    def load(cls, models: Path | None, allow_paper: bool = False) -> Registry:
        """Load the baselines and the checkpoints of a folder.

        Args:
            models: the folder, as ``load_checkpoints`` takes it; None: no checkpoints.
            allow_paper: whether to load models of the paper protocol. Such a model was trained on states
                that contain the near future, and its forecasts from live states are worse than its
                published figures; it is for reproducing published tables. If False, such models are
                ``passed_over``, and a folder with nothing else is an error.

        Raises:
            CheckpointError: a checkpoint is damaged, or all are of the paper protocol and that is not
                allowed.
            DuplicateModelError: two models have the same name and version.
        """
        allowed: list[Forecaster] = []
        passed_over: list[Checkpoint] = []
        for checkpoint in [] if models is None else load_checkpoints(models):
            if allow_paper or _is_causal(checkpoint.info):
                allowed.append(checkpoint.forecaster())
            else:
                passed_over.append(checkpoint)
        if passed_over and not allowed:
            _refuse(passed_over[0])
        return cls([*baselines(), *allowed], [checkpoint.info for checkpoint in passed_over])

    def get(self, name: str) -> Forecaster:
        """Return a model.

        Args:
            name: ``name`` or ``name@version``. A name alone means its newest version of the causal
                protocol, or its newest version if none is causal.

        Raises:
            UnknownModelError: there is no such model.
        """
        base, pinned, version = name.partition("@")
        versions = self._models.get(base, {})
        if versions and not pinned:
            return versions[max(versions, key=lambda number: (_is_causal(versions[number].info), number))]
        try:
            return versions[Version(version)]
        except (InvalidVersion, KeyError):
            namesakes = [info.full_name for info in self.passed_over if info.name == base]
            raise UnknownModelError(name, [info.full_name for info in self.infos()], namesakes) from None

    def infos(self) -> list[ModelInfo]:
        """Return the infos of all models, by name, then by version, oldest first."""
        return [
            versions[version].info
            for _, versions in sorted(self._models.items())
            for version in sorted(versions)
        ]

    def __contains__(self, name: object) -> bool:
        """Return whether ``get`` finds a model of that name."""
        if not isinstance(name, str):
            return False
        try:
            self.get(name)
        except UnknownModelError:
            return False
        return True


def _is_causal(info: ModelInfo) -> bool:
    return info.protocol.value == "causal"  # comparing with the enumeration would import torch


def baselines() -> list[Forecaster]:
    """Return the models that need no checkpoint."""
    return [forecaster for module in _BASELINES for forecaster in import_module(module).baselines()]


def load_checkpoints(folder: Path) -> Iterator[Checkpoint]:
    """Yield the checkpoints in a folder, in the order of their folders' names.

    Args:
        folder: a folder of checkpoints: each folder in it whose name does not begin with a dot is one.

    Raises:
        CheckpointError: there is no such folder, or a checkpoint is damaged.
    """
    from model.checkpoint import CheckpointError, load_checkpoint  # noqa: PLC0415 (see above)

    if not folder.is_dir():
        raise CheckpointError(folder, "there is no such folder of checkpoints")
    for one in checkpoint_folders(folder):
        yield load_checkpoint(one)


def checkpoint_folders(folder: Path) -> list[Path]:
    """Return the folders in a folder of checkpoints, by name, but none whose name begins with a dot."""
    return [one for one in sorted(folder.iterdir()) if one.is_dir() and not one.name.startswith(".")]


def _refuse(checkpoint: Checkpoint) -> NoReturn:
    from model.checkpoint import CheckpointError  # noqa: PLC0415 (see above)

    raise CheckpointError(
        checkpoint.folder,
        f"{checkpoint.info.full_name} is of the paper protocol, and there is no other checkpoint: it was "
        "trained on states that contain the near future, which a live service cannot see; load it with "
        "--allow-paper-protocol, but only to reproduce published tables",
    )
