"""The training loop."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from model.data.augmentation import mirror
from model.data.holdups import hold
from model.networks.forecaster import Networks
from model.training import processes
from model.training.annealing import ANNEALED, KL_SHARE, Z_LOGIT_CLIP, cooldown, learning_rate
from model.training.config import TrainingConfig, TrainingError
from model.training.learner import Batch
from model.training.learners import make_learner
from model.training.objectives import Weights
from model.training.sampling import epoch_order, epoch_seed, random_sides, random_turns
from model.training.source import BatchSource
from model.training.state import Progress, load_state, save_state

Validate = Callable[[Networks[Any]], dict[str, float]]
"""Networks (in evaluation mode) → figures by name; ``SCORE`` among them."""
Report = Callable[[Progress, dict[str, float]], None]
"""Told of each epoch: where the run stands, and the epoch's figures."""
Tick = Callable[[int, int], None]
"""Told of each step: batches done, batches in the epoch."""

SCORE = "fde_ml_6s_m"
"""The figure that the best epoch is chosen by, the smaller the better."""
BEST_FILE = "best.safetensors"
"""Parameters of the best epoch, in the run's folder."""


LEAST_SHARE = 0.5
"""Of a network's parameters that a start has to bring."""


class Trainer:
    """A run: resumes where it was interrupted, at the last whole epoch.

    With torch.distributed initialised (torchrun), each process takes its share of every batch, and
    gradients are averaged over the processes.

    Args:
        config: the run's settings.
        train: pairs to train on.
        validate: judges networks after each epoch.
        folder: where state and best parameters are kept.
        device: of the networks.
        start: parameters to begin with, where they fit; the others begin random.
    """

    def __init__(
        self,
        config: TrainingConfig,
        train: BatchSource,
        validate: Validate,
        folder: Path,
        device: torch.device,
        start: Mapping[str, Tensor] | None = None,
    ) -> None:
        self.config = config
        self._train = train
        self._validate = validate
        self._folder = folder
        self._device = device
        torch.manual_seed(config.seed)  # initial parameters are the same in every process
        self.learner = make_learner(config, train, device)
        self.networks = self.learner.networks
        if start is not None:
            begin_with(self.networks, start)
        self._average = running_mean(self.networks, config.averaging)
        self._epoch_steps = len(self._order(epoch=0)) // config.batch_size or 1
        resumed = load_state(folder, config, self.learner, self._others())
        self.progress = resumed or Progress(epoch=0, step=0, best_epoch=0, best_score=None, seconds=0.0)

    def run(self, report: Report, tick: Tick) -> None:
        """Trains to the last epoch.

        Args:
            report: called after each epoch, in the first process only.
            tick: called after each step.

        Raises:
            TrainingError: the run has diverged; what was saved before is still there.
        """
        while self.progress.epoch < self.config.epochs:
            figures = self._epoch(tick)
            if processes.rank() == 0:
                figures |= self._judge()
                save_state(self._folder, self.config, self.progress, self.learner, self._others())
                report(self.progress, figures)

    def best(self) -> dict[str, Tensor]:
        """Parameters of the best epoch so far, on the CPU."""
        return load_file(self._folder / BEST_FILE)

    def _others(self) -> dict[str, nn.Module]:
        return {} if self._average is None else {"average": self._average}

    def _judged(self) -> Networks[Any]:
        """The networks that are judged and kept."""
        return self.networks if self._average is None else cast("Networks[Any]", self._average.module)

    def _judge(self) -> dict[str, float]:
        networks = self._judged().eval()
        figures = self._validate(networks)
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
        tensors = {k: v.detach().cpu().contiguous() for k, v in self._judged().state_dict().items()}
        temporary = self._folder / f"{BEST_FILE}.new"
        save_file(tensors, temporary)
        temporary.replace(self._folder / BEST_FILE)

    def _epoch(self, tick: Tick) -> dict[str, float]:
        """One epoch of steps; returns the mean of each term, the learning rate and the seconds."""
        config, epoch, steps = self.config, self.progress.epoch, self._epoch_steps
        # What is random in an epoch hangs on its number alone
        torch.manual_seed(epoch_seed(config.seed, epoch) + processes.rank())
        generator = torch.Generator().manual_seed(epoch_seed(config.seed, epoch))
        order = self._order(epoch)
        for module in self.learner.modules().values():
            module.train()
        started = time.perf_counter()
        sums: dict[str, Tensor] = {}
        sizes = self.learner.batch_sizes
        for done in range(1, steps + 1):
            # Every part of a step goes through all pairs, each begins elsewhere in their order
            numbers = ((done - 1 + part * steps // len(sizes)) % steps for part in range(len(sizes)))
            batches = [self._batch(order, n, size, generator) for n, size in zip(numbers, sizes, strict=True)]
            terms = self._step(batches)
            for name, term in terms.items():
                sums[name] = sums.get(name, torch.zeros((), device=self._device)) + term
            tick(done, steps)
        means = {name: (total / steps).item() for name, total in sums.items()}
        seconds = time.perf_counter() - started
        self.progress = replace(self.progress, epoch=epoch + 1, seconds=self.progress.seconds + seconds)
        return means | {"learning_rate": self._rate(), "seconds": seconds}

    def _order(self, epoch: int) -> Tensor:
        """Return the pairs that an epoch shows, in its order."""
        config, train = self.config, self._train
        return epoch_order(
            train.turned,
            config.curved_copies,
            config.seed,
            epoch,
        )

    def _batch(self, order: Tensor, number: int, size: int, generator: torch.Generator) -> Batch:
        """This process's share of the first ``size`` of a batch. Batches are whole ones: in a small last
        one the mutual information would be noisy."""
        start = number * self.config.batch_size
        indices = order[start : start + size]
        turns = random_turns(len(indices), generator) if self.config.rotate else None
        sides = random_sides(len(indices), generator) if self.config.mirror else None
        mine = slice(processes.rank(), None, processes.world())
        features, future = self._train.batch(indices[mine], None if turns is None else turns[mine])
        if self.config.leaving_share < 1:
            future = hold(future, self._train.leaving[indices[mine]], self.config.leaving_share, generator)
        batch = Batch(features, future)
        return batch if sides is None else Batch(*mirror(*batch, sides[mine].to(self._device)))

    def _step(self, batches: Sequence[Batch]) -> dict[str, Tensor]:
        step = self.progress.step
        annealed = step if self.config.start is None else step + ANNEALED
        asked = self.progress.epoch >= self.config.epochs_apart
        displacement = self.config.displacement_weight if asked else 0.0
        weights = Weights(
            self.config.kl_weight * KL_SHARE(annealed),
            Z_LOGIT_CLIP(annealed),
            least_step_likelihood=self.config.least_step_likelihood,
            displacement=displacement,
            apart=self.config.apart_weight,
        )
        terms = self.learner.step(batches, weights, self._rate())
        if self._average is not None:
            self._average.update_parameters(self.networks)
        self.progress = replace(self.progress, step=step + 1)
        return terms

    def _rate(self) -> float:
        config, step, steps = self.config, self.progress.step, self._epoch_steps
        rate = learning_rate(
            config.learning_rate, step, config.learning_rate_decay, config.least_learning_rate
        )
        if config.warmup_steps:
            rate *= min(1.0, (step + 1) / config.warmup_steps)
        return rate * cooldown(step, config.epochs * steps, config.cooldown_epochs * steps)


def running_mean(networks: nn.Module, kept: float) -> AveragedModel | None:
    """Networks whose parameters are an exponential running mean of others' (Polyak and Juditsky 1992); None
    where nothing is to be kept of them."""
    return AveragedModel(networks, multi_avg_fn=get_ema_multi_avg_fn(kept)) if kept else None


def begin_with(networks: nn.Module, given: Mapping[str, Tensor]) -> None:
    """Puts parameters into networks where names and shapes fit; what is computed (buffers) stays.

    Raises:
        TrainingError: they are not even half of the networks' parameters: this is no start.
    """
    wanted = dict(networks.named_parameters())
    fitting = {n: t for n, t in given.items() if n in wanted and wanted[n].shape == t.shape}
    share = sum(t.numel() for t in fitting.values()) / sum(p.numel() for p in wanted.values())
    if share < LEAST_SHARE:
        raise TrainingError(f"start: fits {share:.0%} of the network's parameters only")
    networks.load_state_dict(fitting, strict=False)
