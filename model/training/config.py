"""How a method is trained: one TOML file each in ``methods/``.

Where it says nothing, a method is trained as by the authors' released code: those are the defaults here,
but for ``calibrate`` and ``precision``. Its table ``published`` says what that code has in place of the
file's own settings.
"""

import json
import tomllib
from collections.abc import Mapping
from enum import StrEnum
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from model.features.spec import Frame
from model.networks.config import AnyNetworkConfig, CoverNetConfig, NetworkConfig
from model.training.mixture_objective import MixtureWeights
from model.training.precision import Precision


class TrainingError(Exception):
    """Training cannot go on as asked; the text says why."""


class Method(StrEnum):
    """Methods that can be trained."""

    CAB = "cab"
    TRAJECTRON = "trajectron"
    TRAJECTRON_NO_CONTEXT = "trajectron-no-context"
    REWEIGHT = "reweight"
    RUBIZ = "rubiz"
    HALENTNET = "halentnet"
    HALENTNET_NO_CONTEXT = "halentnet-no-context"
    COVERNET = "covernet"


BLIND = frozenset({Method.CAB, Method.REWEIGHT, Method.RUBIZ})
"""Methods whose objectives compare with a blind forecast."""

_IN_AGENT_FRAME = frozenset({Method.CAB, Method.TRAJECTRON, Method.TRAJECTRON_NO_CONTEXT})
"""Methods with networks of the agent's frame."""


class TrainingConfig(BaseModel):
    """Everything that a run depends on but the data; written beside its checkpoints."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Method
    description: str
    """One sentence on the method, for those who look at the model."""
    network: AnyNetworkConfig
    history_frames: int = Field(default=5, ge=2)
    epochs: int = Field(default=40, ge=1)
    batch_size: int = Field(default=256, ge=1)
    calibrate: bool = True
    """Whether the widths of the forecasts and the temperature of their modes are fitted after training."""
    adversarial_batch_size: int = Field(default=256, ge=1)
    """Pairs in the batches of HalentNet's adversarial parts; at most ``batch_size``."""
    kl_weight: float = Field(default=100.0, gt=0)
    """Of KL(q ‖ p), at the end of its annealing; as released, 100."""
    least_step_likelihood: float = -6.0
    """nats; see ``objectives.Weights``."""
    apart_weight: float = Field(default=5.0, ge=0)
    """λ_KL, of CAB alone: how much full and blind latents are pressed apart; as released, 5, beside a
    ``kl_weight`` of 100."""
    displacement_weight: float = Field(default=0.0, ge=0)
    """1/m, of the distance of the modes (of CoverNet, the members) from the truth, summed over the steps and
    expected under their probabilities; as released, 0. The likelihood alone leaves it open which mode is the
    likeliest: this asks that it be a near one."""
    displacement_after: int = Field(default=0, ge=0)
    """Epochs without it, at most half of them, and none after a ``start``: with it from the beginning, modes
    come to lie on each other before they have learned to differ."""
    learning_rate: float = Field(gt=0)
    """At the first step; decays by ``learning_rate_decay`` a step, not below ``least_learning_rate``."""
    learning_rate_decay: float = Field(default=0.9999, gt=0, le=1)
    least_learning_rate: float = Field(default=1e-5, ge=0)
    cooldown_epochs: int = Field(default=0, ge=0)
    """The last epochs, over which the learning rate goes down to 0."""
    warmup_steps: int = Field(default=0, ge=0)
    """Steps over which the learning rate comes up from 0."""
    averaging: float = Field(default=0.0, ge=0, lt=1)
    """What a step leaves of the running mean of the parameters, e.g. 0.999; the mean is what is judged and
    kept. 0: the parameters themselves are."""
    dropout_factor: float = Field(default=1.0, ge=0, lt=2)
    """On the networks' dropout rates; as released, 1."""
    precision: Precision = Precision.BFLOAT16
    """Of convolutions and decoder in training."""
    start: str | None = None
    """The trained model (name@version) whose parameters a run began with; None: random ones."""
    gradient_clip: float = Field(default=1.0, gt=0)
    """Bound of the gradient's norm."""
    rotate: bool = True
    """Turn each agent's surroundings by a random multiple of 15° (the map patch is agent-aligned)."""
    mirror: bool = False
    """Exchange left and right around every other agent, at random; as released, no."""
    curved_copies: int = Field(default=2, ge=1)
    """How often an epoch shows a pair whose path is curved."""
    leaving_share: float = Field(default=1.0, ge=0, le=1)
    """Share of the pairs that stood and leave within 6 s that are shown as they are; the others stay
    (``model.data.holdups``). The prediction challenge picks what moves: of its pairs that stood every one
    leaves, of everyday standing cars one in sixty."""
    seed: int = 0
    variants: int = Field(default=0, ge=0)
    """V, noisy reports of each training pair (``model.data.sensing``) that are drawn from beside the recorded
    states; in the agent's frame only."""
    hide: bool = False
    """Take map and neighbours away at random (``model.data.hiding``); in the agent's frame only."""
    block: bool = False
    """Put somebody who stands beyond where some agents went (``model.data.holdups``); in the agent's frame,
    with neighbours."""
    jitter: bool = False
    """Move histories and maps a little each time, and show scenes in other sizes (``model.data.jittering``);
    in the agent's frame only."""
    weight_decay: float = Field(default=0.0, ge=0)
    """Decoupled from the gradient (AdamW, Loshchilov and Hutter 2019), per unit of learning rate."""
    mixture: MixtureWeights = MixtureWeights()
    """Weights of the objective in the agent's frame."""
    keep: Literal["best", "last"] = "best"
    """Which epoch is kept: the best on the validation split, or the last one."""

    @model_validator(mode="after")
    def _network_fits_method(self) -> "TrainingConfig":
        if isinstance(self.network, CoverNetConfig) is not (self.method is Method.COVERNET):
            raise ValueError(f"a network of kind {self.network.kind} does not learn by {self.method.value}")
        if self.method in BLIND and not self.network.supports_blind:
            raise ValueError(
                f"network: blind is none, but {self.method.value} learns to forecast blindly, too"
            )
        return self

    @model_validator(mode="after")
    def _mirrors_what_is_covered(self) -> "TrainingConfig":
        if self.mirror and self.method is Method.COVERNET:
            raise ValueError("mirror: covernet's set of trajectories does not cover mirrored ones")
        return self

    @model_validator(mode="after")
    def _suits_the_frame(self) -> "TrainingConfig":
        if not self.in_agent_frame:
            if self.variants or self.hide or self.block or self.jitter or self.mixture != MixtureWeights():
                raise ValueError(
                    "variants, hide, block, jitter and mixture are for networks of the agent's frame"
                )
            return self
        if self.method not in _IN_AGENT_FRAME:
            raise ValueError(f"frame: {self.method.value} does not learn in the agent's frame")
        if self.block and isinstance(self.network, NetworkConfig) and not self.network.neighbor_types:
            raise ValueError("block: the network sees no neighbours")
        if self.rotate:
            raise ValueError("rotate: in the agent's frame a scene that is turned is the same scene")
        return self

    @model_validator(mode="after")
    def _cools_within_the_run(self) -> "TrainingConfig":
        if self.cooldown_epochs > self.epochs:
            raise ValueError(f"cooldown_epochs {self.cooldown_epochs} is more than epochs {self.epochs}")
        return self

    @property
    def in_agent_frame(self) -> bool:
        """Whether the network sees and forecasts in the agent's frame."""
        return isinstance(self.network, NetworkConfig) and self.network.frame is Frame.AGENT

    @property
    def epochs_apart(self) -> int:
        """Epochs without the displacement: see ``displacement_after``."""
        return 0 if self.start is not None else min(self.displacement_after, self.epochs // 2)

    def toml(self) -> str:
        """The settings as a file for ``load_config``; what is given on the command line is left out."""
        left_out = {"method", "start"} if self.in_agent_frame else {"method", "start", "mixture"}
        values = self.model_dump(mode="json", exclude=left_out, exclude_none=True)
        tables = {name: values.pop(name) for name in ("mixture", "network") if name in values}
        lines = _toml_lines(values)
        for name, table in tables.items():
            lines += ["", f"[{name}]", *_toml_lines(table)]
        return "\n".join(lines)


def _toml_lines(values: Mapping[str, Any]) -> list[str]:
    """Return assignments; strings, numbers, booleans and lists of them are written alike in JSON and TOML."""
    return [f"{name} = {json.dumps(value)}" for name, value in values.items()]


def parse_method(name: str) -> Method:
    """A method by its name.

    Raises:
        TrainingError: there is none of that name.
    """
    try:
        return Method(name)
    except ValueError:
        raise TrainingError(f"there is no method {name!r}; there are {', '.join(Method)}") from None


def load_config(
    method: Method, file: Path | None = None, published: bool = False, **changes: object
) -> TrainingConfig:
    """A method's settings.

    Args:
        method: whose.
        file: TOML to take them from instead of the one that comes with the package.
        published: train as the released code does, but for ``calibrate`` and ``precision``; of the file, its
            table ``published``, description and network (without what the released one lacks) count.
        changes: single settings that go before the file's; None counts as not given. Of fewer epochs than are
            to cool down, all cool down.

    Raises:
        TrainingError: the file is missing or wrong, naming it and the setting.
    """
    source = resources.files("model.training") / "methods" / f"{method.value}.toml" if file is None else file
    try:
        values: dict[str, Any] = tomllib.loads(source.read_text(encoding="utf-8"))
        if "start" in values:
            raise TrainingError(f"{source}: start is a checkpoint's folder, to be given to train itself")
        released = values.pop("published", None)
        if published:
            values = _as_published(values, released, str(source))
        given: dict[str, Any] = {name: value for name, value in changes.items() if value is not None}
        config = TrainingConfig.model_validate({"method": method, **values, **_cooled(values, given)})
    except OSError as error:
        raise TrainingError(f"{source}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        faults = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise TrainingError(f"{source}: {faults}") from error
    except ValueError as error:
        raise TrainingError(f"{source}: {error}") from error
    if config.method is not method:
        raise TrainingError(f"{source}: is of method {config.method.value}, not {method.value}")
    return config


def _as_published(values: Mapping[str, Any], released: object, source: str) -> dict[str, Any]:
    """Of a file's values what the method is, with the file's table of what the released code has."""
    if not isinstance(released, dict):
        raise TrainingError(f"{source}: has no table [published]")
    if strange := released.keys() & {"method", "description", "network", "start"}:
        raise TrainingError(f"{source}: published: {', '.join(sorted(strange))} cannot be there")
    kept = {name: values[name] for name in ("description", "network") if name in values}
    if isinstance(network := kept.get("network"), dict):
        ours = {"max_control_sigma", "frame", "far_map", "min_sigma_m"}
        kept["network"] = {name: value for name, value in network.items() if name not in ours}
    return {**released, **kept}


def _cooled(values: Mapping[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """What is given; where it makes fewer epochs than the file cools down, they all do."""
    cooling, epochs = values.get("cooldown_epochs"), given.get("epochs")
    if isinstance(cooling, int) and isinstance(epochs, int) and epochs < cooling:
        return {"cooldown_epochs": epochs, **given}
    return given
