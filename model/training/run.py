"""Training from recorded data to a checkpoint (``cab-forecast train``)."""

import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from model.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from model.data.batches import Batches, JoinedPairs
from model.data.cache import Cache
from model.data.cache_builder import open_cache
from model.data.scenes import Reader
from model.data.sources import READERS
from model.forecaster import ModelInfo, Protocol
from model.networks.agent_frame import AgentFrameNetwork
from model.scenes.scene import AgentType
from model.training import processes
from model.training.calibration import (
    AnyCalibration,
    calibrate,
    calibrate_by_horizon,
    fit_by_horizon,
    fit_calibration,
)
from model.training.card import LICENSE, RAN_AWAY, Origin, model_card
from model.training.config import TrainingConfig
from model.training.loop import OnEpoch, Trainer
from model.training.sampling import BatchSource
from model.training.state import Progress, RunLog
from model.training.validation import Validation

SAMPLES = 200
"""Trajectories drawn for each pair for the sampled figures of a card."""
DRAWS = 200
"""Positions drawn from each mixture for the calibration figures of a card."""


@dataclass(frozen=True)
class Source:
    """Data to train on."""

    kind: str
    path: Path
    train_split: str
    validation_split: str
    protocol: Protocol
    report_split: str | None = None
    """Split of the card's figures; None: the validation split."""
    also: tuple[tuple[str, Path, str], ...] = ()
    """More pairs to train on: kind, path and split."""

    def reader(self) -> Reader:
        """Return the reader of the data.

        Raises:
            DataError: the data is missing.
        """
        return READERS[self.kind](self.path)


@dataclass(frozen=True)
class Run:
    """A training run: settings, data and output."""

    config: TrainingConfig
    source: Source
    out: Path
    """Folder of the run: state, log, and at the end the checkpoint in ``checkpoint/``."""
    cache: Path
    """Folder of the caches, which runs may share."""
    version: str
    """Version of the checkpoint."""
    start: Checkpoint | None = None
    """Checkpoint whose parameters the run begins with."""

    def train(
        self,
        on_epoch: OnEpoch,
        on_step: Callable[[int, int, int], None],
        on_message: Callable[[str], None],
    ) -> Path:
        """Train, resuming the run in ``out``, and write the best epoch as a checkpoint.

        Args:
            on_epoch: called after each epoch, in the first process only.
            on_step: called after each step: (epoch, batches done, batches in the epoch).
            on_message: called with a text about whatever else happens.

        Returns:
            The checkpoint's folder.

        Raises:
            TrainingError: the run cannot be resumed, or it has diverged.
            DataError: the data is bad.
        """
        device = processes.local_device()
        first = processes.join(device)
        train, validated, reported = processes.first_then_others(lambda: self._open_caches(on_message))
        network = self.config.network
        validation = Validation(validated, network, device)
        batches = JoinedPairs([Batches(cache, device, network, packed_maps=True) for cache in train])
        parameters = None if self.start is None else self.start.tensors
        trainer = Trainer(self.config, batches, validation, self.out, device, parameters)
        with RunLog(self.out) as log:

            def add(progress: Progress, figures: dict[str, float]) -> None:
                log.add(progress, figures)
                on_epoch(progress, figures)

            trainer.run(add, lambda done, of: on_step(trainer.progress.epoch + 1, done, of))
        if first:
            source = self.source
            names = [(source.kind, source.train_split), *((kind, split) for kind, _, split in source.also)]
            data = "; ".join(
                f"{kind}, split {split}: {_pairs(cache)} pairs"
                for (kind, split), cache in zip(names, train, strict=True)
            )
            split = f"{source.kind}, split {source.report_split or source.validation_split}"
            origin = Origin(
                data,
                source.protocol,
                f"{split} ({len(reported)} pairs)",
                f"{source.kind}, split {source.validation_split}",
                self._command(),
                _machine(),
            )
            report_on = Validation(reported, network, device)
            self._write_checkpoint(trainer, batches, validation, report_on, origin, on_message)
        return self.out / "checkpoint"

    def _command(self) -> str:
        """Return the command that repeats the run, with placeholders for paths."""
        source = self.source
        start = "" if self.start is None else " --start START"
        also = "".join(
            f"--also {kind}:{path if kind == 'synthetic' else 'DATA'}@{split} "
            for kind, path, split in source.also
        )
        report = "" if source.report_split is None else f"--report-split {source.report_split} "
        return (
            f"cab-forecast train {self.config.method.value} --data {source.kind}:DATA "
            f"--protocol {source.protocol.value} --train-split {source.train_split} "
            f"--validation-split {source.validation_split} {also}{report}--version {self.version} "
            f"--config SETTINGS.toml{start} --out OUT"
        )

    def _open_caches(self, on_message: Callable[[str], None]) -> tuple[list[Cache], Cache, Cache]:
        """Return the caches for training, validation and the report; build missing or stale ones first."""
        source, config = self.source, self.config
        reader = source.reader()

        def opened(kind: str, reader: Reader, split: str, variants: int = 0) -> Cache:
            return open_cache(
                self.cache,
                reader,
                kind,
                split,
                source.protocol,
                config.network,
                config.history_frames,
                on_message,
                variants,
            )

        train = [opened(source.kind, reader, source.train_split, config.variants)]
        for kind, path, split in source.also:
            train.append(opened(kind, READERS[kind](path), split, config.variants))
        validated = opened(source.kind, reader, source.validation_split)
        reported = (
            validated if source.report_split is None else opened(source.kind, reader, source.report_split)
        )
        return train, validated, reported

    def _write_checkpoint(
        self,
        trainer: Trainer,
        train: BatchSource,
        validation: Validation,
        report_on: Validation,
        origin: Origin,
        on_message: Callable[[str], None],
    ) -> None:
        # The configuration of the networks, which includes what was determined when training began
        config, network = self.config, trainer.networks.config
        trainer.networks.load_state_dict(trainer.best())
        trainer.networks.eval()
        calibration: AnyCalibration | None = None
        if config.calibrate:
            vehicles = trainer.networks.of(AgentType.VEHICLE)
            if isinstance(vehicles, AgentFrameNetwork):
                calibration = fit_by_horizon(vehicles, validation.pairs)
                calibrate_by_horizon(vehicles, calibration)
            else:
                pairs = validation.pairs if config.in_agent_frame else train
                calibration = fit_calibration(vehicles, pairs)
                calibrate(vehicles, calibration)
            if calibration.ran_away:
                on_message(f"calibration: {RAN_AWAY}")
        figures = report_on.evaluate(trainer.networks, samples=SAMPLES, draws=DRAWS)
        begun = "" if config.start is None else f"; begun with {config.start}"
        info = ModelInfo(
            name=config.method.value,
            version=self.version,
            protocol=origin.protocol,
            description=config.description,
            agent_types=network.agent_types,
            context_types=network.neighbor_types,
            history_frames=config.history_frames,
            modes=network.modes,
            uses_map=network.uses_map,
            uses_neighbors=bool(network.neighbor_types),
            supports_blind=network.supports_blind,
            trained_on=f"{origin.data}; {trainer.progress.epoch} epochs, seed {config.seed}{begun}",
            benchmark={name: round(value, 6) for name, value in figures.items()},
            license=LICENSE,
        )
        tensors = {name: tensor.cpu() for name, tensor in trainer.networks.state_dict().items()}
        card = model_card(config, origin, trainer.progress, self.version, figures, calibration)
        folder = self.out / "checkpoint"
        save_checkpoint(folder, info, network, tensors, card)
        load_checkpoint(folder).forecaster()  # fails here rather than when it is served


def _pairs(cache: Cache) -> int:
    """Return the number of pairs of a cache, without their variants."""
    return len(cache) // (1 + cache.manifest.key.variants)


def _machine() -> str:
    if torch.cuda.is_available():
        return f"one {torch.cuda.get_device_name()}"
    return f"{torch.get_num_threads()} cores of an {platform.machine()} CPU"
