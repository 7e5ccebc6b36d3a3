"""Settings of a training run: one TOML file for each method in ``methods/``.

A setting that a file leaves out has the value of the authors' released code, except for ``calibrate`` and
``precision``. The file's table ``published`` holds the values of the released code where the file's own
settings differ from them.
"""

import json
import tomllib
from collections.abc import Mapping
from enum import StrEnum
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import torch
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError, model_validator

from model.features.spec import Frame
from model.networks.config import AnyNetworkConfig, CoverNetConfig, NetworkConfig


class TrainingError(Exception):
    """A fault that ends training; the text gives the reason."""


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


class Precision(StrEnum):
    """Precision of the convolutions and of the unrolled decoder in training.

    Parameters, latents, the heads' outputs, dynamics and loss are float32 in both cases. In evaluation
    everything is float32.
    """

    FLOAT32 = "float32"
    BFLOAT16 = "bfloat16"

    def dtype_on(self, device: torch.device) -> torch.dtype:
        """Return the torch type on a device.

        A CPU without instructions for bfloat16 emulates it, up to 16 times slower than float32; there it is
        float32.
        """
        if self is Precision.FLOAT32 or (device.type == "cpu" and not _has_bfloat16()):
            return torch.float32
        return torch.bfloat16


def _has_bfloat16() -> bool:
    """Return whether the CPU computes in bfloat16."""
    capabilities = torch.cpu.get_capabilities()
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def _renamed(old: str, new: str) -> AliasChoices:
    """Return the names of a setting that had another one, which saved runs, cards and files still have."""
    return AliasChoices(new, old)


class MixtureWeights(BaseModel):
    """Weights of the terms of the agent-frame objective (``model.training.mixture_objective``)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    nll: float = Field(default=1.0, ge=0, validation_alias=_renamed("likelihood", "nll"))
    """Weight of the negative log-likelihood of a step, nats, averaged over the steps."""
    joint_nll: float = Field(default=0.0, ge=0, validation_alias=_renamed("joint_likelihood", "joint_nll"))
    """Weight of the negative log-likelihood of the whole trajectory, nats per step."""
    min_ade: float = Field(default=1.0, ge=0, validation_alias=_renamed("nearest", "min_ade"))
    """1/m, weight of the mean distance of the nearest mode (winner takes all)."""
    min_ade_5: float = Field(default=0.0, ge=0, validation_alias=_renamed("nearest_of_5", "min_ade_5"))
    """1/m, weight of the mean distance of the nearest among the five likeliest modes, which planners and
    nuscenes-devkit look at."""
    min_ade_10: float = Field(default=0.0, ge=0, validation_alias=_renamed("nearest_of_10", "min_ade_10"))
    """1/m, the same among the ten likeliest modes."""
    most_likely_ade: float = Field(
        default=0.0, ge=0, validation_alias=_renamed("likeliest", "most_likely_ade")
    )
    """1/m, weight of the mean distance of the likeliest mode; no gradient reaches the probabilities."""
    classification: float = Field(default=0.0, ge=0, validation_alias=_renamed("choice", "classification"))
    """Weight of the cross-entropy of p(z | x) with soft targets: modes weighted by their distances."""
    classification_range_m: float = Field(
        default=1.0, gt=0, validation_alias=_renamed("choice_range_m", "classification_range_m")
    )
    """m; the soft target of a mode is proportional to exp(−distance / range)."""
    expected_ade: float = Field(default=1.0, ge=0, validation_alias=_renamed("expected", "expected_ade"))
    """1/m, weight of the mean distance expected under p(z | x)."""
    off_road: float = Field(default=0.0, ge=0)
    """Weight of the probability of the modes that leave the road at any step."""
    collision: float = Field(default=0.0, ge=0)
    """Weight of the probability of the modes that drive through a standing neighbour."""
    proposal: float = Field(default=0.5, ge=0)
    """Weight of the distances of the proposals, relative to those of the refined modes."""
    blind: float = Field(default=1.0, ge=0)
    """Weight of all terms of the blind forecast (CAB's λ)."""
    blind_share: float = Field(default=1.0, gt=0, le=1)
    """Share of a batch that is also forecast blindly."""
    blind_kl: float = Field(default=0.1, ge=0, validation_alias=_renamed("apart", "blind_kl"))
    """λ_KL of CAB: weight of the divergence of full and blind latents (``objectives.cab_kl``), which is
    maximised."""


class TrainingConfig(BaseModel):
    """All settings of a run except its data; they are saved beside its state."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Method
    description: str
    """One sentence on the method, for readers of the model's info."""
    network: AnyNetworkConfig
    history_frames: int = Field(default=5, ge=2)
    epochs: int = Field(default=40, ge=1)
    batch_size: int = Field(default=256, ge=1)
    calibrate: bool = True
    """True if the widths of the forecasts and the temperature of their modes are fitted after training."""
    adversarial_batch_size: int = Field(default=256, ge=1)
    """Pairs in the batches of HalentNet's adversarial steps; at most ``batch_size``."""
    kl_weight: float = Field(default=100.0, gt=0)
    """Weight of KL(q ‖ p) at the end of its annealing; as released, 100."""
    min_step_likelihood: float = Field(
        default=-6.0, validation_alias=_renamed("least_step_likelihood", "min_step_likelihood")
    )
    """nats, lower clamp of a step's log-likelihood in CAB, Reweight and RUBiZ; as released, −6."""
    blind_kl_weight: float = Field(
        default=5.0, ge=0, validation_alias=_renamed("apart_weight", "blind_kl_weight")
    )
    """λ_KL of CAB alone: weight of the divergence of full and blind latents (``objectives.cab_kl``), which is
    maximised; as released, 5, beside a ``kl_weight`` of 100."""
    displacement_weight: float = Field(default=0.0, ge=0)
    """1/m, weight of the distance of the modes (of CoverNet, the members of its set) from the truth, summed
    over the steps and expected under their probabilities; as released, 0. The likelihood alone does not
    determine which mode is the likeliest; this term asks for a near one."""
    displacement_warmup_epochs: int = Field(
        default=0, ge=0, validation_alias=_renamed("displacement_after", "displacement_warmup_epochs")
    )
    """Epochs without the displacement term, at most half of all, and none after a ``start``. With the term
    from the beginning, modes collapse onto each other before they have learned to differ."""
    learning_rate: float = Field(gt=0)
    """Learning rate of the first step; it decays by ``learning_rate_decay`` a step, down to
    ``min_learning_rate``."""
    learning_rate_decay: float = Field(default=0.9999, gt=0, le=1)
    min_learning_rate: float = Field(
        default=1e-5, ge=0, validation_alias=_renamed("least_learning_rate", "min_learning_rate")
    )
    cooldown_epochs: int = Field(default=0, ge=0)
    """The last epochs, over which the learning rate goes down to 0."""
    warmup_steps: int = Field(default=0, ge=0)
    """Steps over which the learning rate comes up from 0."""
    ema_decay: float = Field(default=0.0, ge=0, lt=1, validation_alias=_renamed("averaging", "ema_decay"))
    """Decay of the exponential moving average of the parameters, e.g. 0.999; the average is what is evaluated
    and kept. 0: no average, the parameters themselves are."""
    dropout_factor: float = Field(default=1.0, ge=0, lt=2)
    """Factor on the networks' dropout rates; as released, 1."""
    precision: Precision = Precision.BFLOAT16
    """Precision of convolutions and decoder in training."""
    start: str | None = None
    """The trained model (name@version) whose parameters the run began with; None: random ones."""
    gradient_clip: float = Field(default=1.0, gt=0)
    """Maximum norm of the gradient."""
    rotate: bool = True
    """True if each agent's surroundings are turned by a random multiple of 15° (the map patch is aligned with
    the agent)."""
    mirror: bool = False
    """True if every other agent, at random, has left and right exchanged; as released, no."""
    curved_oversampling: int = Field(
        default=2, ge=1, validation_alias=_renamed("curved_copies", "curved_oversampling")
    )
    """Number of times that an epoch shows a pair with a curved path."""
    leaving_keep_probability: float = Field(
        default=1.0, ge=0, le=1, validation_alias=_renamed("leaving_share", "leaving_keep_probability")
    )
    """Probability that a pair that stood and leaves within 6 s is shown as recorded; otherwise it stays
    (``model.data.perturbation``). The prediction challenge selects moving agents: all of its pairs that
    stood leave, of everyday standing cars one in sixty."""
    seed: int = 0
    variants: int = Field(default=0, ge=0)
    """V, number of noisy reports of each training pair (``model.data.sensing``) beside the recorded states;
    agent frame only."""
    context_dropout: bool = Field(default=False, validation_alias=_renamed("hide", "context_dropout"))
    """True if maps and neighbours are dropped at random (``model.data.perturbation``); agent frame only."""
    stopped_vehicles: bool = Field(default=False, validation_alias=_renamed("block", "stopped_vehicles"))
    """True if a stopped vehicle is inserted beyond where some agents went (``model.data.perturbation``);
    agent frame with neighbours only."""
    jitter: bool = False
    """True if histories and maps are moved a little each time, and scenes are shown in other sizes
    (``model.data.perturbation``); agent frame only."""
    weight_decay: float = Field(default=0.0, ge=0)
    """Decoupled weight decay (AdamW, Loshchilov and Hutter 2019), per unit of learning rate."""
    mixture: MixtureWeights = MixtureWeights()
    """Weights of the agent-frame objective."""
    keep: Literal["best", "last"] = "best"
    """Epoch that is kept: the best on the validation split, or the last one."""

    @model_validator(mode="after")
    def _network_fits_method(self) -> "TrainingConfig":
        if isinstance(self.network, CoverNetConfig) is not (self.method is Method.COVERNET):
            raise ValueError(f"{self.method.value} does not train a network of kind {self.network.kind}")
        if self.method in BLIND and not self.network.supports_blind:
            raise ValueError(f"network: blind is none, but {self.method.value} trains a blind forecast")
        return self

    @model_validator(mode="after")
    def _set_covers_what_is_shown(self) -> "TrainingConfig":
        if self.mirror and self.method is Method.COVERNET:
            raise ValueError("mirror: covernet's set of trajectories does not cover mirrored ones")
        return self

    @model_validator(mode="after")
    def _settings_fit_frame(self) -> "TrainingConfig":
        if not self.in_agent_frame:
            perturbed = self.variants or self.context_dropout or self.stopped_vehicles or self.jitter
            if perturbed or self.mixture != MixtureWeights():
                raise ValueError(
                    "variants, context_dropout, stopped_vehicles, jitter and mixture are for networks of the "
                    "agent's frame"
                )
            return self
        if isinstance(self.network, CoverNetConfig) and self.mixture != MixtureWeights():
            raise ValueError("mixture: covernet's objective has no such terms")
        if self.stopped_vehicles and not self.network.neighbor_types:
            raise ValueError("stopped_vehicles: the network sees no neighbours")
        if self.rotate:
            raise ValueError("rotate: in the agent's frame a rotated scene is the same scene")
        return self

    @model_validator(mode="after")
    def _cooldown_fits_run(self) -> "TrainingConfig":
        if self.cooldown_epochs > self.epochs:
            raise ValueError(f"cooldown_epochs {self.cooldown_epochs} is more than epochs {self.epochs}")
        return self

    @property
    def in_agent_frame(self) -> bool:
        """True if the network sees and forecasts in the agent's frame."""
        return self.network.frame is Frame.AGENT

    @property
    def displacement_start(self) -> int:
        """The epoch, counted from 0, at which the displacement term begins."""
        return 0 if self.start is not None else min(self.displacement_warmup_epochs, self.epochs // 2)

    def toml(self) -> str:
        """Return the settings as a file for ``load_config``, without those of the command line."""
        uses_mixture = self.in_agent_frame and isinstance(self.network, NetworkConfig)
        left_out = {"method", "start"} if uses_mixture else {"method", "start", "mixture"}
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
    """Return a method by its name.

    Raises:
        TrainingError: there is no method of that name.
    """
    try:
        return Method(name)
    except ValueError:
        raise TrainingError(f"there is no method {name!r}; there are {', '.join(Method)}") from None


def load_config(
    method: Method, file: Path | None = None, published: bool = False, **changes: object
) -> TrainingConfig:
    """Return the settings of a method.

    Args:
        method: the method.
        file: TOML file to read instead of the one in the package.
        published: train as the released code does, except for ``calibrate`` and ``precision``. Of the file,
            only its table ``published``, description and network (without what the released one lacks) count.
        changes: single settings that override the file's; None: not given. With fewer epochs than the file's
            cooldown, all epochs cool down.

    Raises:
        TrainingError: the file is missing or wrong; names it and the setting.
    """
    source = resources.files("model.training") / "methods" / f"{method.value}.toml" if file is None else file
    try:
        values: dict[str, Any] = tomllib.loads(source.read_text(encoding="utf-8"))
        if "start" in values:
            raise TrainingError(f"{source}: start is a checkpoint's folder; give it to train itself")
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
        raise TrainingError(f"{source}: is for method {config.method.value}, not {method.value}")
    return config


def _as_published(values: Mapping[str, Any], released: object, source: str) -> dict[str, Any]:
    """Return the settings of the released code, with the file's description and network."""
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
    """Return the given changes; with fewer epochs than the file's cooldown, all epochs cool down."""
    cooling, epochs = values.get("cooldown_epochs"), given.get("epochs")
    if isinstance(cooling, int) and isinstance(epochs, int) and epochs < cooling:
        return {"cooldown_epochs": epochs, **given}
    return given
