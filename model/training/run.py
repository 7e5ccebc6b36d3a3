"""From recorded data to a checkpoint: what ``cab-forecast train`` does."""

import os
import platform
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed

from model.checkpoint import load_checkpoint, save_checkpoint
from model.data.batches import Batches
from model.data.cache import Cache, build_cache
from model.data.cache_layout import CacheKey
from model.data.nuscenes_pred import NuscenesPredReader
from model.data.scenes import DataError, Reader
from model.forecaster import ModelInfo, Protocol
from model.networks.config import BlindContext
from model.training.card import LICENSE, Origin, model_card
from model.training.config import TrainingConfig, TrainingError
from model.training.logs import RunLog
from model.training.loop import Report, Trainer
from model.training.state import Progress
from model.training.validation import Validation


def _official(path: Path) -> Reader:
    from model.data.nuscenes import NuscenesReader  # noqa: PLC0415 (an extra, with numpy < 2)

    try:
        return NuscenesReader(path)
    except ImportError as error:
        raise TrainingError(f"official nuScenes data needs the extra benchmark: {error}") from error


READERS: dict[str, Callable[[Path], Reader]] = {"nuscenes_pred": NuscenesPredReader, "nuscenes": _official}
"""Readers of data sets by the KIND of KIND:PATH."""

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

    def reader(self) -> Reader:
        """Opens the data.

        Raises:
            DataError: it is not there.
        """
        return READERS[self.kind](self.path)


def parse_data(text: str) -> tuple[str, Path]:
    """KIND and PATH of KIND:PATH.

    Raises:
        TrainingError: it is no such thing, or the kind is unknown.
    """
    kind, colon, path = text.partition(":")
    if not colon or not path or kind not in READERS:
        raise TrainingError(f"data: {text!r} is not KIND:PATH with KIND one of {', '.join(READERS)}")
    return kind, Path(path)


def parse_protocol(name: str) -> Protocol:
    """A protocol by its name.

    Raises:
        TrainingError: there is none of that name.
    """
    try:
        return Protocol(name)
    except ValueError:
        raise TrainingError(f"there is no protocol {name!r}; there are {', '.join(Protocol)}") from None


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

    def train(
        self,
        command: str,
        report: Report,
        tick: Callable[[int, int, int], None],
        said: Callable[[str], None],
    ) -> Path:
        """Trains, resuming what is in ``out``, and writes the best epoch as a checkpoint.

        Args:
            command: how the run was started, for its card.
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
        first = _join_processes(device)
        train, judged = (
            self._open_cache(s, said) for s in (self.source.train_split, self.source.validation_split)
        )
        validation = Validation(judged, self.config.network, device)
        batches = Batches(train, device, self.config.network)
        trainer = Trainer(self.config, batches, validation, self.out, device)
        with RunLog(self.out) as log:

            def add(progress: Progress, figures: dict[str, float]) -> None:
                log.add(progress, figures)
                report(progress, figures)

            trainer.run(add, lambda done, of: tick(trainer.progress.epoch + 1, done, of))
        if first:
            data = f"{self.source.kind}, split {self.source.train_split}: {len(train)} pairs"
            split = f"{self.source.kind}, split {self.source.validation_split} ({len(judged)} pairs)"
            origin = Origin(data, self.source.protocol, split, command, _machine())
            self._write_checkpoint(trainer, validation, origin)
        return self.out / "checkpoint"

    def _open_cache(self, split: str, said: Callable[[str], None]) -> Cache:
        """The cache of a split, made first where it is not there or stale."""
        source, config = self.source, self.config
        reader = source.reader()
        key = CacheKey.of(reader, split, source.protocol, config.network, config.history_frames)
        kinds = "".join(kind.value[0] for kind in config.network.neighbor_types) or "none"
        name = f"{source.kind}-{split}-{source.protocol.value}-{config.history_frames}-{kinds}"
        try:
            return Cache.open(self.cache / name, key)
        except DataError as error:
            said(f"making the cache of {split}: {error}")
        build_cache(reader, split, source.protocol, config.network, config.history_frames, self.cache / name)
        return Cache.open(self.cache / name, key)

    def _write_checkpoint(self, trainer: Trainer, validation: Validation, origin: Origin) -> None:
        config, network = self.config, self.config.network
        trainer.networks.load_state_dict(trainer.best())
        trainer.networks.eval()
        figures = validation.judge(trainer.networks, samples=SAMPLES, draws=DRAWS)
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
            supports_blind=network.blind is not BlindContext.NONE,
            trained_on=f"{origin.data}; {trainer.progress.epoch} epochs, seed {config.seed}",
            benchmark={name: round(value, 6) for name, value in figures.items()},
            license=LICENSE,
        )
        tensors = {name: tensor.cpu() for name, tensor in trainer.networks.state_dict().items()}
        card = model_card(config, origin, trainer.progress, self.version, figures)
        folder = self.out / "checkpoint"
        save_checkpoint(folder, info, network, tensors, card)
        load_checkpoint(folder).forecaster()  # what cannot be read again is no checkpoint


def _device() -> torch.device:
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


def _join_processes(device: torch.device) -> bool:
    """Joins the other processes of torchrun, if any; whether this is the first."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        return True
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    return torch.distributed.get_rank() == 0


def _machine() -> str:
    if torch.cuda.is_available():
        return f"one {torch.cuda.get_device_name()}"
    return f"{torch.get_num_threads()} cores of an {platform.machine()} CPU"
