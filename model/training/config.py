"""How a method is trained: one TOML file each in ``methods/``."""

import tomllib
from enum import StrEnum
from importlib import resources
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from model.networks.config import NetworkConfig
from model.training.objectives import OBJECTIVES


class TrainingError(Exception):
    """Training cannot go on as asked; the text says why."""


class Method(StrEnum):
    """Methods that can be trained."""

    CAB = "cab"
    TRAJECTRON = "trajectron"
    TRAJECTRON_NO_CONTEXT = "trajectron-no-context"
    REWEIGHT = "reweight"
    RUBIZ = "rubiz"


class TrainingConfig(BaseModel):
    """Everything that a run depends on but the data; written beside its checkpoints."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Method
    description: str
    """One sentence on the method, for those who look at the model."""
    network: NetworkConfig
    history_frames: int = Field(default=5, ge=2)
    epochs: int = Field(default=40, ge=1)
    batch_size: int = Field(default=256, ge=1)
    learning_rate: float = Field(gt=0)
    """At the first step; decays by ``learning_rate_decay`` a step, not below ``least_learning_rate``."""
    learning_rate_decay: float = Field(default=0.9999, gt=0, le=1)
    least_learning_rate: float = Field(default=1e-5, ge=0)
    gradient_clip: float = Field(default=1.0, gt=0)
    """Bound of the gradient's norm."""
    rotate: bool = True
    """Turn each agent's surroundings by a random multiple of 15° (the map patch is agent-aligned)."""
    curved_copies: int = Field(default=2, ge=1)
    """How often an epoch shows a pair whose path is curved."""
    seed: int = 0

    @property
    def objective(self) -> str:
        """Name of the objective."""
        return self.method.value


def parse_method(name: str) -> Method:
    """A method by its name.

    Raises:
        TrainingError: there is none of that name.
    """
    try:
        return Method(name)
    except ValueError:
        raise TrainingError(f"there is no method {name!r}; there are {', '.join(Method)}") from None


def load_config(method: Method, file: Path | None = None, **changes: object) -> TrainingConfig:
    """A method's settings.

    Args:
        method: whose.
        file: TOML to take them from instead of the one that comes with the package.
        changes: single settings that go before the file's; None counts as not given.

    Raises:
        TrainingError: the file is missing or wrong, naming it and the setting.
    """
    source = resources.files("model.training") / "methods" / f"{method.value}.toml" if file is None else file
    try:
        values = tomllib.loads(source.read_text(encoding="utf-8"))
        given = {name: value for name, value in changes.items() if value is not None}
        config = TrainingConfig.model_validate({"method": method, **values, **given})
    except OSError as error:
        raise TrainingError(f"{source}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise TrainingError(f"{source}: {faults}") from error
    except ValueError as error:
        raise TrainingError(f"{source}: {error}") from error
    if config.method is not method:
        raise TrainingError(f"{source}: is of method {config.method.value}, not {method.value}")
    if config.objective not in OBJECTIVES:
        raise TrainingError(f"{source}: there is no objective {config.objective}")
    return config
