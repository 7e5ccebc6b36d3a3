"""Selection of the models that are evaluated: checkpoints of one protocol, baselines, the physics oracle."""

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
    """The evaluation cannot run as requested; the text says why."""


@dataclass(frozen=True)
class Learned:
    """A checkpoint with its forecaster."""

    config: AnyNetworkConfig
    forecaster: Forecaster

    @property
    def info(self) -> ModelInfo:
        """Description of the model."""
        return self.forecaster.info


@dataclass(frozen=True)
class Selection:
    """The models of an evaluation, in the order of the tables."""

    baselines: tuple[Forecaster, ...]
    oracle: bool
    """True if the physics oracle is among them."""
    learned: tuple[Learned, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """``name@version`` of every model, and the name of the oracle."""
        oracle = (ORACLE,) if self.oracle else ()
        return (
            *(one.info.full_name for one in self.baselines),
            *oracle,
            *(one.info.full_name for one in self.learned),
        )


def select(folder: Path | None, protocol: Protocol, only: Collection[str] = ()) -> Selection:
    """Select the models to evaluate.

    Args:
        folder: folder of checkpoints (``load_checkpoints``); None: no checkpoints.
        protocol: protocol of the inputs; checkpoints of the other one are left out.
        only: names or ``name@version`` of the models to keep; empty: all.

    Raises:
        CheckpointError: the folder does not exist, or a checkpoint is damaged.
        EvaluationError: a name is unknown, or all models are wanted and no checkpoint fits the protocol.
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
    return Selection(
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
    duplicates = sorted({name for name in keys if keys.count(name) > 1})
    if duplicates:
        raise EvaluationError(f"there are two models {', '.join(duplicates)}")
    names = {info.name for info in infos} | {ORACLE}
    for name in only:
        if name not in names and name not in keys:
            raise EvaluationError(
                f"only: there is no model {name!r} of the {protocol.value} protocol; "
                f"there are {', '.join(sorted(names))}"
            )
