"""Every model that can forecast here, by name and version."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from packaging.version import InvalidVersion, Version

if TYPE_CHECKING:
    from model.forecaster import Forecaster, ModelInfo

# Models are imported when a registry is made: what only names a registry need not wait for torch.


class UnknownModelError(LookupError):
    """There is no such model; the message lists those that there are."""

    def __init__(self, name: str, available: Sequence[str]) -> None:
        super().__init__(f"there is no model {name!r}; there are {', '.join(available) or 'none'}")
        self.name = name
        self.available = tuple(available)


class DuplicateModelError(ValueError):
    """Two models have the same name and version."""


class Registry:
    """Models by ``name@version``; of a name alone, the newest version.

    Args:
        forecasters: the models.

    Raises:
        DuplicateModelError: two have the same name and version.
    """

    def __init__(self, forecasters: Iterable[Forecaster]) -> None:
        self._models: dict[str, dict[Version, Forecaster]] = {}
        for forecaster in forecasters:
            info = forecaster.info
            versions = self._models.setdefault(info.name, {})
            if (version := Version(info.version)) in versions:
                raise DuplicateModelError(f"there are two models {_key(info)}")
            versions[version] = forecaster

    @classmethod
    def load(cls, models: Path | None, allow_paper: bool = False) -> Registry:
        """The baselines, and the checkpoints of a folder.

        Args:
            models: every folder in it that does not begin with a dot is a checkpoint; None: no checkpoints.
            allow_paper: whether models of the paper protocol are welcome. Such a model was trained on
                states that contain the near future, and forecasts worse than it should on live ones:
                it is for reproducing published tables.

        Raises:
            CheckpointError: a checkpoint is damaged, or of the paper protocol while that is not allowed.
            DuplicateModelError: two models have the same name and version.
        """
        return cls([*_baselines(), *([] if models is None else _checkpoints(models, allow_paper))])

    def get(self, name: str) -> Forecaster:
        """A model.

        Args:
            name: ``name`` (its newest version) or ``name@version``.

        Raises:
            UnknownModelError: there is none.
        """
        base, pinned, version = name.partition("@")
        versions = self._models.get(base, {})
        if versions and not pinned:
            return versions[max(versions)]
        try:
            return versions[Version(version)]
        except (InvalidVersion, KeyError):
            raise UnknownModelError(name, [_key(info) for info in self.infos()]) from None

    def infos(self) -> list[ModelInfo]:
        """What is known of each model, by name, then by version, oldest first."""
        return [
            versions[version].info
            for _, versions in sorted(self._models.items())
            for version in sorted(versions)
        ]

    def __contains__(self, name: object) -> bool:
        """Whether ``get`` finds a model of that name."""
        if not isinstance(name, str):
            return False
        try:
            self.get(name)
        except UnknownModelError:
            return False
        return True


def _key(info: ModelInfo) -> str:
    return f"{info.name}@{info.version}"


def _baselines() -> Iterator[Forecaster]:
    """What needs no checkpoint. A new baseline is a line here."""
    from model import kalman, physics  # noqa: PLC0415 (see above)

    yield from physics.baselines()
    yield kalman.Kalman()


def _checkpoints(models: Path, allow_paper: bool) -> Iterator[Forecaster]:
    from model.checkpoint import CheckpointError, load_checkpoint  # noqa: PLC0415 (see above)
    from model.forecaster import Protocol  # noqa: PLC0415

    if not models.is_dir():
        raise CheckpointError(models, "there is no such folder of checkpoints")
    for folder in sorted(models.iterdir()):
        if folder.name.startswith(".") or not folder.is_dir():
            continue
        checkpoint = load_checkpoint(folder)
        if checkpoint.info.protocol is Protocol.PAPER and not allow_paper:
            raise CheckpointError(
                folder,
                f"{_key(checkpoint.info)} is of the paper protocol: it was trained on states that contain "
                "the near future, which a live service cannot see; load it, with allow_paper, only to "
                "reproduce published tables",
            )
        yield checkpoint.forecaster()
