"""From recorded data to a checkpoint: what ``cab-forecast train`` does."""

import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from model.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from model.data.batches import Batches, JoinedPairs
from model.data.cache import Cache
from model.data.caches import open_cache
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
from model.training.logs import RunLog
from model.training.loop import Report, Trainer
from model.training.source import BatchSource
from model.training.state import Progress
from model.training.validation import Validation

SAMPLES = 200
"""Trajectories a pair for the sampled figures of a card."""
DRAWS = 200
"""Of each mixture, for its calibration."""


@dataclass(frozen=True)
class Source:
    """What to train on."""

    kind: str
    path: Path
    train_split: str
    validation_split: str
    protocol: Protocol
    report_split: str | None = None
    """The split that the card's figures are of; None: the validation split."""
    also: tuple[tuple[str, Path, str], ...] = ()
    """Kind, path and split of more pairs to train on."""

    def reader(self) -> Reader:
        """Opens the data.

        Raises:
            DataError: it is not there.
        """
        return READERS[self.kind](self.path)


@dataclass(frozen=True)
class Run:
    """What is to be trained, on what, and where to."""

    config: TrainingConfig
    source: Source
    out: Path
    """State, log, and at the end the checkpoint in ``checkpoint/``."""
    cache: Path
    """Folder of the caches; runs may share it."""
    version: str
    """Of the checkpoint."""
    start: Checkpoint | None = None
    """Whose parameters to begin with."""

    def train(
        self,
        report: Report,
        tick: Callable[[int, int, int], None],
        said: Callable[[str], None],
    ) -> Path:
        """Trains, resuming what is in ``out``, and writes the best epoch as a checkpoint.

        Args:
            report: told of each epoch, in the first process only.
            tick: told of each step: epoch, batches done, batches in the epoch.
            said: told in words what else goes on.

        Returns:
            The checkpoint's folder.

        Raises:
            TrainingError: the run cannot be resumed.
            DataError: the data is bad.
        """
        device = _device()
        first = processes.join(device)
        train, judged, reported = processes.first_alone(lambda: self._open_caches(said))
        network = self.config.network
        validation = Validation(judged, network, device)
        batches = JoinedPairs([Batches(cache, device, network, packed_maps=True) for cache in train])
        parameters = None if self.start is None else self.start.tensors
        trainer = Trainer(self.config, batches, validation, self.out, device, parameters)
        with RunLog(self.out) as log:

            def add(progress: Progress, figures: dict[str, float]) -> None:
                log.add(progress, figures)
                report(progress, figures)

            trainer.run(add, lambda done, of: tick(trainer.progress.epoch + 1, done, of))
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
            self._write_checkpoint(trainer, batches, validation, report_on, origin, said)
        return self.out / "checkpoint"

    def _command(self) -> str:
        """What repeats the run, in terms of any machine."""
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

    def _open_caches(self, said: Callable[[str], None]) -> tuple[list[Cache], Cache, Cache]:
        """Return the caches to train on, to choose the epoch on, and to report on; they are made first where
        they are not there or stale."""
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
                said,
                variants,
            )

        train = [opened(source.kind, reader, source.train_split, config.variants)]
        for kind, path, split in source.also:
            train.append(opened(kind, READERS[kind](path), split, config.variants))
        judged = opened(source.kind, reader, source.validation_split)
        reported = judged if source.report_split is None else opened(source.kind, reader, source.report_split)
        return train, judged, reported

    def _write_checkpoint(
        self,
        trainer: Trainer,
        train: BatchSource,
        validation: Validation,
        report_on: Validation,
        origin: Origin,
        said: Callable[[str], None],
    ) -> None:
        # The networks' own: what is made when training begins is known there only
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
                calibration = fit_calibration(vehicles, train)
                calibrate(vehicles, calibration)
            if calibration.ran_away:
                said(f"calibration: {RAN_AWAY}")
        figures = report_on.judge(trainer.networks, samples=SAMPLES, draws=DRAWS)
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
        load_checkpoint(folder).forecaster()  # what cannot be read again is no checkpoint


def _pairs(cache: Cache) -> int:
    """Return how many pairs a cache is of, their variants not counted."""
    return len(cache) // (1 + cache.manifest.key.variants)


def _device() -> torch.device:
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


def _machine() -> str:
    if torch.cuda.is_available():
        return f"one {torch.cuda.get_device_name()}"
    return f"{torch.get_num_threads()} cores of an {platform.machine()} CPU"
