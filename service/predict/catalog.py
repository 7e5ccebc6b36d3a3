"""Loaded models by name, with the default and the fallback."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol as Interface

import structlog

from cab.forecast.v1 import model_service_pb2 as pb
from model.explanation.donors import Donors
from model.forecaster import Forecaster, ModelInfo, Protocol
from model.registry import UnknownModelError
from model.scenes.scene import STEP_SECONDS, AgentType
from service.errors import UnknownModel
from service.settings import FALLBACK_MODEL, SettingsError

_log = structlog.get_logger(__name__)

_PREFERRED = "cab"
_ELSE = "kalman"
_MAX_NAME = 128

PROTOCOLS = {Protocol.CAUSAL: pb.INPUT_PROTOCOL_CAUSAL, Protocol.PAPER: pb.INPUT_PROTOCOL_PAPER}
TYPE_NUMBERS = {
    AgentType.VEHICLE: pb.AGENT_TYPE_VEHICLE,
    AgentType.PEDESTRIAN: pb.AGENT_TYPE_PEDESTRIAN,
    AgentType.CYCLIST: pb.AGENT_TYPE_CYCLIST,
    AgentType.UNKNOWN: pb.AGENT_TYPE_UNKNOWN,
}


class Models(Interface):
    """Interface of a registry, such as ``model.registry.Registry``."""

    def get(self, name: str) -> Forecaster:
        """Return a model by "name" or "name@version".

        Raises:
            UnknownModelError: the model is not loaded.
        """

    def infos(self) -> list[ModelInfo]:
        """Return all models, sorted by name, then version."""


@dataclass(frozen=True)
class Catalog:
    """Loaded models, the default and the fallback among them."""

    models: Models
    default: Forecaster
    fallback: Forecaster
    by_name: Mapping[str, Forecaster]
    """All models by "name" and by "name@version"."""
    default_by_caller: Mapping[str, Forecaster] = field(default_factory=dict)
    """Defaults of some callers, by the name of their key."""
    donors: Donors | None = None
    """What stands for absent parts in explanations; None: the null context."""

    def get(self, name: str, caller: str | None = None) -> Forecaster:
        """Return a model by "name" or "name@version"; the caller's default for the empty name.

        Args:
            name: the name.
            caller: name of the caller's key; None: there is none.

        Raises:
            UnknownModel: the model is not loaded.
        """
        if not name:
            return self.default if caller is None else self.default_by_caller.get(caller, self.default)
        if len(name) > _MAX_NAME:
            raise UnknownModel(f"no model has a name of {len(name)} characters")
        if (forecaster := self.by_name.get(name)) is not None:
            return forecaster
        try:
            return self.models.get(name)  # a version may be spelt in other ways
        except UnknownModelError as error:
            raise UnknownModel(str(error)) from error

    def describe(self, info: ModelInfo, caller: str | None = None) -> pb.Model:
        """Return the contract's description of a model.

        Args:
            info: the model.
            caller: name of the caller's key; None: there is none.
        """
        return pb.Model(
            name=info.name,
            version=info.version,
            protocol=PROTOCOLS[info.protocol],
            is_default=info == self.get("", caller).info,
            description=info.description,
            agent_types=[TYPE_NUMBERS[kind] for kind in info.agent_types],
            context_types=[TYPE_NUMBERS[kind] for kind in info.context_types],
            horizon=info.horizon,
            step=STEP_SECONDS,
            history_frames=info.history_frames,
            modes=info.modes,
            uses_map=info.uses_map,
            uses_neighbors=info.uses_neighbors,
            trained_on=info.trained_on,
            benchmark=info.benchmark,
            license=info.license,
            supports_blind=info.supports_blind,
        )


def reference(info: ModelInfo) -> pb.ModelReference:
    """Return the contract's reference to a model."""
    return pb.ModelReference(name=info.name, version=info.version, protocol=PROTOCOLS[info.protocol])


def build_catalog(
    models: Models,
    default: str | None,
    default_by_caller: Mapping[str, str] | None = None,
    refused: Sequence[str] = (),
) -> Catalog:
    """Choose default and fallback, and log the default.

    Args:
        models: the loaded models.
        default: the name of the default; None: "cab" if loaded, else "kalman".
        default_by_caller: names of the defaults of some callers, by the name of their key.
        refused: the reasons why checkpoints were refused. One of them may be the default that is missing.

    Raises:
        SettingsError: a required model is not loaded, or a model has a longer horizon than the fallback.
    """
    names = {info.name for info in models.infos()}
    if default is not None:
        name, why = default, "it is configured"
    elif _PREFERRED in names:
        name, why = _PREFERRED, "it is loaded"
    elif refused:
        raise SettingsError(
            f"default_model: {_PREFERRED} is not loaded, and a checkpoint was refused: {refused[0]}; repair "
            "or remove it, or name a default model"
        )
    else:
        name, why = _ELSE, f"{_PREFERRED} is not loaded"
    by_name = {name: models.get(name) for info in models.infos() for name in (info.name, info.full_name)}
    default_model = _require("default_model", models, name, refused)
    fallback = _require("models", models, FALLBACK_MODEL, refused)
    by_caller = {
        caller: _require(f"default_models: {caller}", models, wanted, refused)
        for caller, wanted in (default_by_caller or {}).items()
    }
    catalog = Catalog(models, default_model, fallback, by_name, by_caller)
    for info in models.infos():
        if info.steps > catalog.fallback.info.steps:
            raise SettingsError(
                f"models: {info.name} forecasts further than {FALLBACK_MODEL}, which must stand in"
            )
    info = catalog.default.info
    _log.info("default model", name=info.name, version=info.version, why=why)
    return catalog


def _require(setting: str, models: Models, name: str, refused: Sequence[str]) -> Forecaster:
    """Return a model that a setting names.

    Raises:
        SettingsError: it is not loaded.
    """
    try:
        return models.get(name)
    except UnknownModelError as error:
        reasons = f"; refused: {'; '.join(refused)}" if refused else ""
        raise SettingsError(f"{setting}: {error}{reasons}") from error
