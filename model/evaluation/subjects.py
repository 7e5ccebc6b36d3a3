"""What is evaluated: checkpoints of one protocol, the baselines, the physics oracle."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from model.checkpoint import Checkpoint
from model.forecaster import Forecaster, ModelInfo, Protocol
from model.metrics.oracle import ORACLE
from model.networks.config import AnyNetworkConfig
from model.registry import baselines, load_checkpoints
from model.scenes.scene import AgentType


class EvaluationError(Exception):
    """There is nothing to evaluate as asked; the text says why."""


@dataclass(frozen=True)
class Learned:
    """A checkpoint."""

    config: AnyNetworkConfig
    """Says what it looks at, and how."""
    forecaster: Forecaster

    @property
    def info(self) -> ModelInfo:
        """What is known of it."""
        return self.forecaster.info


@dataclass(frozen=True)
class Subjects:
    """What is evaluated, in the order of the tables."""

    baselines: tuple[Forecaster, ...]
    oracle: bool
    """Of the four physics baselines."""
    learned: tuple[Learned, ...]

    @property
    def rows(self) -> tuple[str, ...]:
        """Keys of all (see ``key``)."""
        oracle = (ORACLE,) if self.oracle else ()
        return (
            *(one.info.full_name for one in self.baselines),
            *oracle,
            *(one.info.full_name for one in self.learned),
        )


def choose(folder: Path | None, protocol: Protocol, only: Collection[str] = ()) -> Subjects:
    """Chooses what is evaluated.

    Args:
        folder: of checkpoints (``load_checkpoints``); None: there is none.
        protocol: checkpoints of another are left out.
        only: names or ``name@version`` of those that are wanted; empty: all.

    Raises:
        CheckpointError: there is no such folder, or a checkpoint is damaged.
        EvaluationError: a name is unknown, or a checkpoint is needed and there is none of that protocol.
    """
    checkpoints = [] if folder is None else list(load_checkpoints(folder))
    fitting = [one for one in checkpoints if _fits(one, protocol)]
    candidates = baselines()
    infos = [*(one.info for one in candidates), *(one.info for one in fitting)]
    _check_names(infos, protocol, only)
    if not fitting and not only:
        where = "no folder of checkpoints is given, and none are bundled" if folder is None else str(folder)
        others = ", ".join(f"{one.info.full_name} ({one.info.protocol.value})" for one in checkpoints)
        raise EvaluationError(
            f"{where}: there is no checkpoint of the {protocol.value} protocol that forecasts vehicles"
            + (f"; there are {others}" if others else "")
        )
    return Subjects(
        tuple(one for one in candidates if _wanted(one.info, only)),
        not only or ORACLE in only,
        tuple(Learned(one.network, one.forecaster()) for one in fitting if _wanted(one.info, only)),
    )


def _fits(checkpoint: Checkpoint, protocol: Protocol) -> bool:
    return checkpoint.info.protocol is protocol and AgentType.VEHICLE in checkpoint.info.agent_types


def _wanted(info: ModelInfo, only: Collection[str]) -> bool:
    return not only or bool({info.name, info.full_name} & set(only))


def _check_names(infos: Sequence[ModelInfo], protocol: Protocol, only: Iterable[str]) -> None:
    keys = [info.full_name for info in infos]
    twice = sorted({name for name in keys if keys.count(name) > 1})
    if twice:
        raise EvaluationError(f"there are two models {', '.join(twice)}")
    names = {info.name for info in infos} | {ORACLE}
    for name in only:
        if name not in names and name not in keys:
            raise EvaluationError(
                f"only: there is no model {name!r} of the {protocol.value} protocol; "
                f"there are {', '.join(sorted(names))}"
            )
