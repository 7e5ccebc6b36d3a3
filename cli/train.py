"""``cab-forecast train``: one training run, resumable."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.failures import fail

if TYPE_CHECKING:
    from model.training.run import Run
    from model.training.state import Progress

_ESTIMATE_AFTER = 4.0
"""s of steps after which the duration of the run is estimated."""
_INTERRUPTED = 130
"""Exit code of a program that Ctrl-C ended, as shells have it."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("train")(train)


def train(
    method: Annotated[
        str,
        typer.Argument(
            help="cab, trajectron, trajectron-no-context, reweight, rubiz, halentnet, "
            "halentnet-no-context or covernet"
        ),
    ],
    data: Annotated[str, typer.Option(help="KIND:PATH of the data, e.g. nuscenes_pred:DIR")],
    out: Annotated[Path, typer.Option(help="Folder of the run; an interrupted run resumes.")],
    protocol: Annotated[
        str, typer.Option(help="Protocol of the inputs: causal, or paper to compare with published tables.")
    ] = "causal",
    train_split: Annotated[str, typer.Option(help="Training split.")] = "train",
    validation_split: Annotated[
        str, typer.Option(help="Validation split, which selects the best epoch.")
    ] = "train_val",
    extra_data: Annotated[
        list[str] | None,
        typer.Option(
            "--extra-data",
            "--also",
            metavar="KIND:PATH@SPLIT",
            help="Additional training pairs; may be repeated.",
        ),
    ] = None,
    report_split: Annotated[
        str | None,
        typer.Option(help="Split of the metrics in the model card. [default: the validation split]"),
    ] = None,
    cache: Annotated[
        Path | None, typer.Option(help="Folder of cached features. [default: OUT/cache]")
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="TOML file of hyperparameters. [default: the method's own]")
    ] = None,
    published: Annotated[
        bool,
        typer.Option(
            "--published", help="Use the objective, learning rates and epochs of the authors' released code."
        ),
    ] = False,
    epochs: Annotated[int | None, typer.Option(min=1, help="Overrides the TOML file.")] = None,
    learning_rate: Annotated[float | None, typer.Option(help="Overrides the TOML file.")] = None,
    seed: Annotated[int | None, typer.Option(help="Overrides the TOML file.")] = None,
    cooldown_epochs: Annotated[
        int | None, typer.Option(min=0, help="Last epochs, over which the learning rate decays to 0.")
    ] = None,
    init_from: Annotated[
        Path | None,
        typer.Option("--init-from", "--start", help="Checkpoint whose parameters initialize the network."),
    ] = None,
    version: Annotated[
        str | None,
        typer.Option(
            help="Version of the new checkpoint. [default: 1.0.0; 1.0.0+paper with --protocol paper]"
        ),
    ] = None,
) -> None:
    """Train a method and write its best epoch as a checkpoint that serve can load."""
    from model.checkpoint import CheckpointError, load_checkpoint  # noqa: PLC0415 (torch is slow to import)
    from model.data.scenes import DataError  # noqa: PLC0415
    from model.data.sources import parse_also, parse_data, parse_protocol  # noqa: PLC0415
    from model.forecaster import Protocol  # noqa: PLC0415
    from model.training.config import TrainingError, load_config, parse_method  # noqa: PLC0415
    from model.training.run import Run, Source  # noqa: PLC0415

    changes: dict[str, object] = {"epochs": epochs, "learning_rate": learning_rate, "seed": seed}
    changes["cooldown_epochs"] = cooldown_epochs
    try:
        initial = None if init_from is None else load_checkpoint(init_from)
        if initial is not None:
            changes["start"] = f"{initial.info.full_name} ({initial.info.protocol.value})"
        kind, path = parse_data(data)
        source = Source(
            kind,
            path,
            train_split,
            validation_split,
            parse_protocol(protocol),
            report_split,
            tuple(parse_also(each) for each in extra_data or ()),
        )
        default = "1.0.0+paper" if source.protocol is Protocol.PAPER else "1.0.0"
        settings = load_config(parse_method(method), config, published=published, **changes)
        _run(Run(settings, source, out, cache or out / "cache", version or default, initial))
    except (TrainingError, DataError, CheckpointError) as error:
        fail(str(error))


def _run(run: "Run") -> None:
    """Train, with a progress bar within the epoch, an estimate, and a line after each epoch."""
    from rich.console import Console  # noqa: PLC0415

    from cli.display import batches_bar  # noqa: PLC0415
    from model.training.loop import SCORE  # noqa: PLC0415

    # Under torchrun, only the process of rank 0 prints
    console = Console(quiet=os.environ.get("RANK", "0") != "0", soft_wrap=True, highlight=False)
    estimate = Estimate(run.config.epochs, console.print)
    epoch_now = 0  # no step has been made yet
    console.print(f"{run.config.method.value}: reading the data")
    try:
        with batches_bar(console) as bar:
            task = bar.add_task("starting", total=None)

            def tick(epoch: int, done: int, batches: int) -> None:
                nonlocal epoch_now
                epoch_now = epoch
                bar.update(task, description=f"epoch {epoch}", completed=done, total=batches)
                estimate.step(epoch, done, batches)

            def report(progress: "Progress", figures: dict[str, float]) -> None:
                is_best = progress.best_epoch == progress.epoch
                best = "best so far" if is_best else f"best {progress.best_epoch}"
                console.print(
                    f"epoch {progress.epoch}: loss {figures['loss']:.3f}, FDE@6s {figures[SCORE]:.2f} m, "
                    f"{figures['seconds']:.0f} s ({best})"
                )

            folder = run.train(report, tick, console.print)
    except KeyboardInterrupt:
        if epoch_now:
            console.print(
                f"interrupted in epoch {epoch_now}: run the same command again to resume at its beginning"
            )
        else:
            console.print("interrupted before the first step: run the same command again to start")
        raise typer.Exit(_INTERRUPTED) from None
    console.print(f"checkpoint: {folder}")


class Estimate:
    """What the first steps tell of a run: that it goes on, and how long it takes."""

    def __init__(
        self, epochs: int, say: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        """
        Args:
            epochs: number of epochs of the whole run.
            say: called with each text.
            clock: the time, s.
        """
        self._epochs = epochs
        self._say = say
        self._clock = clock
        self._first: tuple[float, int] | None = None
        """Time after the first step of this process, and the step."""
        self._told = False

    def step(self, epoch: int, done: int, batches: int) -> None:
        """Hear of a step.

        Args:
            epoch: number of the epoch, from 1 on.
            done: number of steps done in it.
            batches: number of its steps.
        """
        if self._told:
            return
        now = self._clock()
        if self._first is None:
            self._first = now, done
            self._say(
                f"first step of epoch {epoch} done, of {batches} steps in each of {self._epochs} epochs"
            )
            return
        begun, first = self._first
        if now - begun < _ESTIMATE_AFTER and done < batches:
            return
        from model.data.cache_builder import duration_text  # noqa: PLC0415

        self._told = True
        each = (now - begun) / max(done - first, 1)
        left = each * ((self._epochs - epoch) * batches + batches - done)
        self._say(
            f"{each:.2g} s a step: {duration_text(each * batches)} an epoch and {duration_text(left)} "
            "to the end, without the validation after each epoch"
        )
