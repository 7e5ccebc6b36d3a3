"""The training loop."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from model.data.augmentation import mirror
from model.data.perturbation import keep_standing
from model.networks.forecaster import Networks
from model.training import processes
from model.training.config import Method, TrainingConfig, TrainingError
from model.training.covernet import CoverNetLearner
from model.training.halentnet import HalentLearner
from model.training.learner import AgentFrameLearner, Batch, CvaeLearner, Learner
from model.training.sampling import BatchSource, epoch_order, epoch_seed, random_sides, random_turns
from model.training.schedules import learning_rate, loss_weights
from model.training.state import Progress, load_state, save_state

Evaluate = Callable[[Networks[Any]], dict[str, float]]
"""Networks (in evaluation mode) → figures by name, ``SCORE`` among them."""
OnEpoch = Callable[[Progress, dict[str, float]], None]
"""Callback after each epoch: (progress of the run, figures of the epoch)."""
OnStep = Callable[[int, int], None]
"""Callback after each step: (batches done, batches in the epoch)."""

SCORE = "fde_ml_6s_m"
"""Figure by which the best epoch is chosen; smaller is better."""
BEST_FILE = "best.safetensors"
"""Parameters of the best epoch, in the run's folder."""
MIN_START_SHARE = 0.5
"""Share of a network's parameters that a start has to bring."""


class Trainer:
    """A run; if it was interrupted, it is resumed after the last complete epoch.

    With torch.distributed initialised (torchrun), each process takes its share of every batch,
    gradients are averaged over the processes, and the first process alone evaluates and saves.

    Args:
        config: settings of the run.
        train: pairs to train on.
        evaluate: evaluates the networks after each epoch.
        folder: folder of the run, for its state and best parameters.
        device: device of the networks.
        start: parameters to begin with, where they fit; the others begin random.

    Raises:
        TrainingError: the folder holds a run that cannot be resumed with these settings, or the start does
            not fit the network.
    """

    def __init__(
        self,
        config: TrainingConfig,
        train: BatchSource,
        evaluate: Evaluate,
        folder: Path,
        device: torch.device,
        start: Mapping[str, Tensor] | None = None,
    ) -> None:
        self.config = config
        self._train = train
        self._evaluate = evaluate
        self._folder = folder
        self._device = device
        torch.manual_seed(config.seed)  # initial parameters are the same in every process
        self.learner = make_learner(config, train, device)
        self.networks = self.learner.networks
        if start is not None:
            begin_with(self.networks, start)
        self._average = exponential_average(self.networks, config.ema_decay)
        self._epoch_steps = len(self._order(epoch=0)) // config.batch_size or 1
        resumed = load_state(folder, config, self.learner, self._others())
        self.progress = resumed or Progress(epoch=0, step=0, best_epoch=0, best_score=None, seconds=0.0)

    def run(self, on_epoch: OnEpoch, on_step: OnStep) -> None:
        """Train to the last epoch.

        Args:
            on_epoch: called after each epoch, in the first process only.
            on_step: called after each step.

        Raises:
            TrainingError: the run has diverged (in all processes); the state of the epoch before is still
                there.
        """
        while self.progress.epoch < self.config.epochs:
            figures = self._train_epoch(on_step)
            processes.only_first(partial(self._finish_epoch, figures, on_epoch))

    def _finish_epoch(self, figures: dict[str, float], on_epoch: OnEpoch) -> None:
        """Evaluate and save an epoch."""
        figures |= self._evaluate_epoch()
        save_state(self._folder, self.config, self.progress, self.learner, self._others())
        on_epoch(self.progress, figures)

    def best(self) -> dict[str, Tensor]:
        """Return the parameters of the best epoch so far, on the CPU."""
        return load_file(self._folder / BEST_FILE)

    def _others(self) -> dict[str, nn.Module]:
        return {} if self._average is None else {"average": self._average}

    def _evaluated(self) -> Networks[Any]:
        """Return the networks that are evaluated and kept."""
        return self.networks if self._average is None else cast("Networks[Any]", self._average.module)

    def _evaluate_epoch(self) -> dict[str, float]:
        """Return the figures of the epoch, whose parameters are kept if it is the best one."""
        networks = self._evaluated().eval()
        figures = self._evaluate(networks)
        score = figures.get(SCORE, math.nan)
        if not math.isfinite(score):
            raise TrainingError(
                f"the run has diverged: after epoch {self.progress.epoch} no forecast is a number; a smaller "
                "learning rate may help"
            )
        better = self.progress.best_score is None or score < self.progress.best_score
        if better or self.config.keep == "last":
            self.progress = replace(self.progress, best_epoch=self.progress.epoch, best_score=score)
            self._keep_best()
        return figures

    def _keep_best(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        tensors = {k: v.detach().cpu().contiguous() for k, v in self._evaluated().state_dict().items()}
        temporary = self._folder / f"{BEST_FILE}.new"
        save_file(tensors, temporary)
        temporary.replace(self._folder / BEST_FILE)

    def _train_epoch(self, on_step: OnStep) -> dict[str, float]:
        """Train one epoch; return the mean of each term, the learning rate and the seconds."""
        config, epoch, steps = self.config, self.progress.epoch, self._epoch_steps
        # Randomness depends on the epoch's number alone, so that a resumed run repeats it
        torch.manual_seed(epoch_seed(config.seed, epoch) + processes.rank())
        generator = torch.Generator().manual_seed(epoch_seed(config.seed, epoch))
        order = self._order(epoch)
        for module in self.learner.modules().values():
            module.train()
        started = time.perf_counter()
        sums: dict[str, Tensor] = {}
        sizes = self.learner.batch_sizes
        for done in range(1, steps + 1):
            # Each part of a step sees all pairs in an epoch; each begins elsewhere in their order
            numbers = ((done - 1 + part * steps // len(sizes)) % steps for part in range(len(sizes)))
            batches = [self._batch(order, n, size, generator) for n, size in zip(numbers, sizes, strict=True)]
            terms = self._step(batches)
            for name, term in terms.items():
                sums[name] = sums.get(name, torch.zeros((), device=self._device)) + term
            on_step(done, steps)
        means = {name: (total / steps).item() for name, total in sums.items()}
        seconds = time.perf_counter() - started
        self.progress = replace(self.progress, epoch=epoch + 1, seconds=self.progress.seconds + seconds)
        return means | {"learning_rate": self._learning_rate(), "seconds": seconds}

    def _order(self, epoch: int) -> Tensor:
        """Return the indices of the pairs that an epoch shows, in its order."""
        return epoch_order(self._train.turned, self.config.curved_oversampling, self.config.seed, epoch)

    def _batch(self, order: Tensor, number: int, size: int, generator: torch.Generator) -> Batch:
        """Return this process's share of the first ``size`` pairs of a batch.

        There are only whole batches: in a small last one the mutual information would be noisy.
        """
        start = number * self.config.batch_size
        indices = order[start : start + size]
        turns = random_turns(len(indices), generator) if self.config.rotate else None
        sides = random_sides(len(indices), generator) if self.config.mirror else None
        mine = slice(processes.rank(), None, processes.world())
        features, future = self._train.batch(indices[mine], None if turns is None else turns[mine])
        kept = self.config.leaving_keep_probability
        if kept < 1:
            future = keep_standing(future, self._train.leaving[indices[mine]], kept, generator)
        batch = Batch(features, future)
        return batch if sides is None else Batch(*mirror(*batch, sides[mine].to(self._device)))

    def _step(self, batches: Sequence[Batch]) -> dict[str, Tensor]:
        progress = self.progress
        weights = loss_weights(self.config, progress.step, progress.epoch)
        terms = self.learner.step(batches, weights, self._learning_rate())
        if self._average is not None:
            self._average.update_parameters(self.networks)
        self.progress = replace(progress, step=progress.step + 1)
        return terms

    def _learning_rate(self) -> float:
        return learning_rate(self.config, self.progress.step, self._epoch_steps)


def make_learner(config: TrainingConfig, train: BatchSource, device: torch.device) -> Learner:
    """Return the learner of a method.

    Args:
        config: settings of the run.
        train: pairs to train on, for methods that look at all of them first.
        device: device of the networks.
    """
    if config.method in (Method.HALENTNET, Method.HALENTNET_NO_CONTEXT):
        return HalentLearner(config, device)
    if config.method is Method.COVERNET:
        return CoverNetLearner(config, train.paths, device)
    return AgentFrameLearner(config, device) if config.in_agent_frame else CvaeLearner(config, device)


def exponential_average(networks: nn.Module, decay: float) -> AveragedModel | None:
    """Return networks whose parameters are an exponential moving average of the given ones'.

    Polyak and Juditsky 1992. None where the decay is 0.
    """
    return AveragedModel(networks, multi_avg_fn=get_ema_multi_avg_fn(decay)) if decay else None


def begin_with(networks: nn.Module, given: Mapping[str, Tensor]) -> None:
    """Load parameters into networks where names and shapes fit; computed tensors (buffers) stay.

    Raises:
        TrainingError: less than half of the networks' parameters fit.
    """
    wanted = dict(networks.named_parameters())
    fitting = {n: t for n, t in given.items() if n in wanted and wanted[n].shape == t.shape}
    share = sum(t.numel() for t in fitting.values()) / sum(p.numel() for p in wanted.values())
    if share < MIN_START_SHARE:
        raise TrainingError(f"start: fits {share:.0%} of the network's parameters only")
    networks.load_state_dict(fitting, strict=False)
