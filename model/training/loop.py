"""The training loop."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
import torch.distributed
from safetensors.torch import load_file, save_file
from torch import Tensor

from model.cvae import CvaeNetworks
from model.networks.network import AgentNetwork
from model.scene import AgentType
from model.training.annealing import KL_WEIGHT, Z_LOGIT_CLIP, learning_rate
from model.training.config import TrainingConfig
from model.training.objectives import OBJECTIVES, Weights
from model.training.sampling import epoch_order, epoch_seed, random_turns
from model.training.source import BatchSource
from model.training.state import Progress, load_state, save_state

Validate = Callable[[CvaeNetworks], dict[str, float]]
"""Networks (in evaluation mode) → figures by name; ``SCORE`` among them."""
Report = Callable[[Progress, dict[str, float]], None]
"""Told of each epoch: where the run stands, and the epoch's figures."""
Tick = Callable[[int, int], None]
"""Told of each step: batches done, batches in the epoch."""

SCORE = "fde_ml_6s_m"
"""The figure that the best epoch is chosen by, the smaller the better."""
BEST_FILE = "best.safetensors"
"""Parameters of the best epoch, in the run's folder."""


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
    """

    def __init__(
        self,
        config: TrainingConfig,
        train: BatchSource,
        validate: Validate,
        folder: Path,
        device: torch.device,
    ) -> None:
        self.config = config
        self._train = train
        self._validate = validate
        self._folder = folder
        self._device = device
        torch.manual_seed(config.seed)  # initial parameters are the same in every process
        self.networks = CvaeNetworks(config.network).to(device)
        self.optimizer = torch.optim.Adam(self.networks.parameters(), lr=config.learning_rate)
        resumed = load_state(folder, config, self.networks, self.optimizer)
        self.progress = resumed or Progress(epoch=0, step=0, best_epoch=0, best_score=None, seconds=0.0)

    def run(self, report: Report, tick: Tick) -> None:
        """Trains to the last epoch.

        Args:
            report: called after each epoch, in the first process only.
            tick: called after each step.
        """
        while self.progress.epoch < self.config.epochs:
            figures = self._epoch(tick)
            if _rank() == 0:
                figures |= self._judge()
                save_state(self._folder, self.config, self.progress, self.networks, self.optimizer)
                report(self.progress, figures)

    def best(self) -> dict[str, Tensor]:
        """Parameters of the best epoch so far, on the CPU."""
        return load_file(self._folder / BEST_FILE)

    def _judge(self) -> dict[str, float]:
        self.networks.eval()
        figures = self._validate(self.networks)
        score = figures[SCORE]
        if self.progress.best_score is None or score < self.progress.best_score:
            self.progress = replace(self.progress, best_epoch=self.progress.epoch, best_score=score)
            self._keep_best()
        return figures

    def _keep_best(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        tensors = {k: v.detach().cpu().contiguous() for k, v in self.networks.state_dict().items()}
        temporary = self._folder / f"{BEST_FILE}.new"
        save_file(tensors, temporary)
        temporary.replace(self._folder / BEST_FILE)

    def _epoch(self, tick: Tick) -> dict[str, float]:
        """One epoch of steps; returns the mean of each term, the learning rate and the seconds."""
        config, epoch = self.config, self.progress.epoch
        # What is random in an epoch hangs on its number alone
        torch.manual_seed(epoch_seed(config.seed, epoch) + _rank())
        generator = torch.Generator().manual_seed(epoch_seed(config.seed, epoch))
        order = epoch_order(self._train.turned, config.curved_copies, config.seed, epoch)
        batches = len(order) // config.batch_size or 1
        self.networks.train()
        network = self.networks.of(AgentType.VEHICLE)
        started = time.perf_counter()
        sums: dict[str, Tensor] = {}
        for done, indices in enumerate(_split(order, config.batch_size, batches), start=1):
            turns = random_turns(len(indices), generator) if config.rotate else None
            mine = slice(_rank(), None, _world())
            terms = self._step(network, indices[mine], None if turns is None else turns[mine])
            for name, term in terms.items():
                sums[name] = sums.get(name, torch.zeros((), device=self._device)) + term
            tick(done, batches)
        means = {name: (total / batches).item() for name, total in sums.items()}
        seconds = time.perf_counter() - started
        self.progress = replace(self.progress, epoch=epoch + 1, seconds=self.progress.seconds + seconds)
        return means | {"learning_rate": self._rate(), "seconds": seconds}

    def _step(self, network: AgentNetwork, indices: Tensor, turns: Tensor | None) -> dict[str, Tensor]:
        config, step = self.config, self.progress.step
        features, future = self._train.batch(indices, turns)
        weights = Weights(KL_WEIGHT(step), Z_LOGIT_CLIP(step))
        loss = OBJECTIVES[config.objective](network, features, future, weights)
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate()
        self.optimizer.zero_grad(set_to_none=True)
        loss.value.backward()
        _average_gradients(self.networks)
        torch.nn.utils.clip_grad_norm_(self.networks.parameters(), config.gradient_clip)
        self.optimizer.step()
        self.progress = replace(self.progress, step=step + 1)
        return {"loss": loss.value.detach()} | {name: term.detach() for name, term in loss.terms.items()}

    def _rate(self) -> float:
        config = self.config
        return learning_rate(
            config.learning_rate, self.progress.step, config.learning_rate_decay, config.least_learning_rate
        )


def _split(order: Tensor, size: int, batches: int) -> Iterator[Tensor]:
    """Whole batches only: a small last one would have a noisy mutual information."""
    for number in range(batches):
        yield order[number * size : (number + 1) * size]


def _world() -> int:
    return torch.distributed.get_world_size() if torch.distributed.is_initialized() else 1


def _rank() -> int:
    return torch.distributed.get_rank() if torch.distributed.is_initialized() else 0


def _average_gradients(module: torch.nn.Module) -> None:
    """Means of the gradients over all processes."""
    if _world() == 1:
        return
    for parameter in module.parameters():
        if parameter.grad is not None:
            torch.distributed.all_reduce(parameter.grad)
            parameter.grad /= _world()
