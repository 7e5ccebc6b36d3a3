"""Every model that can forecast here, by name and version."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from packaging.version import InvalidVersion, Version

if TYPE_CHECKING:
    from model.checkpoint import Checkpoint
    from model.forecaster import Forecaster, ModelInfo

# Models are imported when a registry is made: what only names a registry need not wait for torch.


class UnknownModelError(LookupError):
    """There is no such model; the message lists those that there are.

    Args:
        name: what was asked for.
        available: what there is.
        passed_over: what is called so but was left out, because it is of the paper protocol.
    """

    def __init__(self, name: str, available: Sequence[str], passed_over: Sequence[str] = ()) -> None:
        text = f"there is no model {name!r}; there are {', '.join(available) or 'none'}"
        if passed_over:
            text += f" (the paper protocol was not allowed, so {', '.join(passed_over)} was not loaded)"
        super().__init__(text)
        self.name = name
        self.available = tuple(available)


class DuplicateModelError(ValueError):
    """Two models have the same name and version."""


class Registry:
    """Models by ``name@version``; of a name alone, the newest version of the causal protocol.

    Args:
        forecasters: the models.
        passed_over: models that were found but left out, because of their protocol.

    Raises:
        DuplicateModelError: two have the same name and version.
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
        """The baselines, and the checkpoints of a folder.

        Args:
            models: the folder of ``load_checkpoints``; None: no checkpoints.
            allow_paper: whether models of the paper protocol are welcome. Such a model was trained on
                states that contain the near future, and forecasts worse than it should on live ones:
                it is for reproducing published tables. Without it they are ``passed_over``, if there are
                others; a folder of nothing else is an error, as nobody can have meant that.

        Raises:
            CheckpointError: a checkpoint is damaged, or all are of the paper protocol while that is not
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
        return cls([*_baselines(), *allowed], [checkpoint.info for checkpoint in passed_over])

    def get(self, name: str) -> Forecaster:
        """A model.

        Args:
            name: ``name`` or ``name@version``. Of a name alone: its newest version of the causal protocol,
                or where it has none, its newest.

        Raises:
            UnknownModelError: there is none.
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


def _is_causal(info: ModelInfo) -> bool:
    return info.protocol.value == "causal"  # the enumeration would bring torch along


def _baselines() -> Iterator[Forecaster]:
    """What needs no checkpoint. A new baseline is a line here."""
    from model.baselines import kalman, physics  # noqa: PLC0415 (see above)

    yield from physics.baselines()
    yield kalman.Kalman()


def load_checkpoints(folder: Path) -> Iterator[Checkpoint]:
    """The checkpoints in a folder, by the names of their folders.

    Args:
        folder: every folder in it that does not begin with a dot is a checkpoint.

    Raises:
        CheckpointError: there is no such folder, or a checkpoint is damaged.
    """
    from model.checkpoint import CheckpointError, load_checkpoint  # noqa: PLC0415 (see above)

    if not folder.is_dir():
        raise CheckpointError(folder, "there is no such folder of checkpoints")
    for one in sorted(folder.iterdir()):
        if one.is_dir() and not one.name.startswith("."):
            yield load_checkpoint(one)


def _refuse(checkpoint: Checkpoint) -> NoReturn:
    from model.checkpoint import CheckpointError  # noqa: PLC0415 (see above)

    raise CheckpointError(
        checkpoint.folder,
        f"{checkpoint.info.full_name} is of the paper protocol, and there is no other checkpoint: it was "
        "trained on states that contain the near future, which a live service cannot see; load it, with "
        "--allow-paper-protocol, only to reproduce published tables",
    )
