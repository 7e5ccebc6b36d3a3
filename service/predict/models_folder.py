"""Models of the server: the baselines and a folder of checkpoints, read at the start and by reloads."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import structlog
from packaging.version import Version

from model.checkpoint import CONFIG_FILE, TENSORS_FILE, load_checkpoint
from model.explanation.donors import FILE as DONORS_FILE
from model.explanation.donors import Donors, DonorsError, load_donors
from model.forecaster import Forecaster, ModelInfo, Protocol
from model.registry import DuplicateModelError, Registry, baselines, checkpoint_folders
from service.predict.canary import check
from service.predict.torch_threads import forward_threads
from service.settings import Engine, Settings, SettingsError, bundled_models

_log = structlog.get_logger(__name__)

Fingerprint: TypeAlias = frozenset[tuple[str, int, int]]
"""Path, size and time of change of each file of the checkpoints in a folder, and of its donors."""


@dataclass(frozen=True)
class RefusedModel:
    """A checkpoint that cannot be served."""

    folder: str
    """Name of its folder."""
    reason: str


@dataclass(frozen=True)
class Source:
    """A checkpoint as it was read."""

    config: str
    """Content of config.json, with the checksum of the weights: it tells whether a folder has changed."""
    info: ModelInfo
    weights: str
    """Checksum of the weights."""
    forecaster: Forecaster | None
    """None if the model's protocol is not allowed."""


class FolderModels(Registry):
    """The baselines and the checkpoints of a folder.

    Args:
        standing: the baselines.
        sources: the checkpoints by folder.
        refused: the checkpoints that cannot be served.
        donors: what stands for absent parts in explanations; None: the folder has none.

    Raises:
        DuplicateModelError: a checkpoint has the name and version of a baseline.
    """

    def __init__(
        self,
        standing: Iterable[Forecaster],
        sources: Mapping[Path, Source],
        refused: Iterable[RefusedModel] = (),
        donors: Donors | None = None,
    ) -> None:
        self.standing = tuple(standing)
        self.sources = dict(sources)
        loaded = [source.forecaster for source in sources.values() if source.forecaster is not None]
        passed_over = [source.info for source in sources.values() if source.forecaster is None]
        super().__init__([*self.standing, *loaded], passed_over)
        self.refused = tuple(refused)
        self.donors = donors


def models_folder(settings: Settings) -> Path | None:
    """Return the folder of the checkpoints: the configured one, else the bundled one, if there is one."""
    return settings.models or bundled_models()


def load_models(settings: Settings, current: object = None) -> FolderModels:
    """Read the models; those that have not changed since the last time are taken over as they are.

    Folders that hold no checkpoint are passed over. A checkpoint that is damaged or that fails the canary
    scene is refused, and the model that its folder gave before stays.

    Args:
        settings: the folder, the engine and the allowed protocols.
        current: the result of the last time; anything else: there is none.

    Raises:
        SettingsError: there is no such folder, or all its models are of the paper protocol, which is not
            allowed.
    """
    folder = models_folder(settings)
    if folder is not None and not folder.is_dir():
        raise SettingsError(f"models: no such folder: {folder}")
    before = current if isinstance(current, FolderModels) else FolderModels(baselines(), {})
    sources: dict[Path, Source] = {}
    changed: dict[Path, str] = {}
    for one, config in _read_configs(folder, before).items():
        last = before.sources.get(one)
        if last is not None and last.config == config:
            sources[one] = last
        else:
            changed[one] = config
    refused = []
    for one, config in changed.items():
        try:
            source = _find(config, before) or _load(one, config, settings)
            _require_new(source, before, sources)
        except Exception as error:  # whatever is wrong with a new model, the others are served
            last = before.sources.get(one)
            _log.warning(
                "model refused",
                folder=str(one),
                reason=str(error),
                stays=None if last is None else last.info.full_name,
            )
            refused.append(RefusedModel(one.name, str(error)))
            if last is None or _identity(last.info) in map(
                _identity, (kept.info for kept in sources.values())
            ):
                continue
            source = last
        sources[one] = source
    models = FolderModels(before.standing, sources, refused, _load_donors(folder))
    if models.passed_over and len(models.passed_over) == len(sources):
        raise SettingsError(
            f"{folder}: {models.passed_over[0].full_name} is of the paper protocol, and there is no other "
            "checkpoint: it was trained on states that contain the near future, which a live service cannot "
            "see; load it with --allow-paper-protocol, but only to reproduce published tables"
        )
    return models


def fingerprint(folder: Path | None) -> Fingerprint:
    """Return what changes when a checkpoint in a folder does."""
    found: set[tuple[str, int, int] | None] = set()
    for one in [] if folder is None or not folder.is_dir() else checkpoint_folders(folder):
        found |= {_stamp(file) for file in (one / CONFIG_FILE, one / TENSORS_FILE)}
    if folder is not None:
        found.add(_stamp(folder / DONORS_FILE))
    return frozenset(stamp for stamp in found if stamp is not None)


def _stamp(file: Path) -> tuple[str, int, int] | None:
    """Return path, size and time of change of a file; None: it cannot be read."""
    try:
        stat = file.stat()
    except OSError:
        return None
    return str(file), stat.st_size, stat.st_mtime_ns


def _load_donors(folder: Path | None) -> Donors | None:
    """Return the donors of a folder; None if it has none, or if their file is damaged, which is logged."""
    if folder is None:
        return None
    try:
        return load_donors(folder)
    except DonorsError as error:
        _log.warning("donors of explanations refused", reason=str(error))
        return None


def _read_configs(folder: Path | None, before: FolderModels) -> dict[Path, str]:
    """Return the content of config.json of each checkpoint; warn of folders that hold none.

    A folder that held a checkpoint before and whose config.json cannot be read now has an empty one.
    """
    configs = {}
    for one in [] if folder is None else checkpoint_folders(folder):
        try:
            configs[one] = (one / CONFIG_FILE).read_text(encoding="utf-8", errors="replace")
        except OSError as error:
            if one in before.sources:
                configs[one] = ""
                continue
            missing = isinstance(error, FileNotFoundError)
            reason = f"it holds no {CONFIG_FILE}" if missing else f"it cannot be read: {error.strerror}"
            _log.warning("folder without a checkpoint passed over", folder=str(one), reason=reason)
    return configs


def _find(config: str, before: FolderModels) -> Source | None:
    """Return the loaded checkpoint of that configuration, if its folder was renamed."""
    return next((source for source in before.sources.values() if source.config == config), None)


def _load(folder: Path, config: str, settings: Settings) -> Source:
    """Read a checkpoint and check it.

    Raises:
        CheckpointError: it is damaged.
        CanaryError: it fails the canary scene.
    """
    checkpoint = load_checkpoint(folder)
    info = checkpoint.info
    weights = json.loads(config)["tensors_sha256"]
    if info.protocol is Protocol.PAPER and not settings.allow_paper_protocol:
        return Source(config, info, weights, None)
    forecaster = checkpoint.forecaster()
    if settings.engine is Engine.ONNXRUNTIME:
        forecaster.compile(forward_threads(settings.threads, settings.workers).width)
    check(forecaster)
    return Source(config, info, weights, forecaster)


def _require_new(source: Source, before: FolderModels, sources: Mapping[Path, Source]) -> None:
    """Refuse a checkpoint whose name and version are taken: responses could not tell the two apart.

    Args:
        source: the checkpoint.
        before: the models that are served.
        sources: the checkpoints that will be served, by folder.

    Raises:
        DuplicateModelError: name and version are those of a baseline, of a checkpoint in another folder, or
            of other weights that are served.
    """
    identity = _identity(source.info)
    name = source.info.full_name
    if identity in {_identity(forecaster.info) for forecaster in before.standing}:
        raise DuplicateModelError(f"{name} is the name of a baseline")
    for folder, other in sources.items():
        if _identity(other.info) == identity:
            raise DuplicateModelError(f"{name} is in the folder {folder.name} already")
    for other in before.sources.values():
        if _identity(other.info) == identity and other.weights != source.weights:
            raise DuplicateModelError(
                f"{name} is served with other weights; new weights need a new version in {CONFIG_FILE}"
            )


def _identity(info: ModelInfo) -> tuple[str, Version]:
    return info.name, Version(info.version)
