"""A training run on the terminal: a bar within the epoch, a line after each."""

import os

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from model.training.loop import SCORE
from model.training.run import Run
from model.training.state import Progress as RunProgress


def show_training(run: Run) -> None:
    """Runs it, and shows how it goes.

    Raises:
        TrainingError: the run cannot be resumed.
        DataError: the data is bad.
    """
    # Under torchrun, one process speaks for all
    console = Console(quiet=os.environ.get("RANK", "0") != "0")
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("batches"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )
    with bar:
        task = bar.add_task("starting", total=None)

        def tick(epoch: int, done: int, batches: int) -> None:
            bar.update(task, description=f"epoch {epoch}", completed=done, total=batches)

        def report(progress: RunProgress, figures: dict[str, float]) -> None:
            best = "best so far" if progress.best_epoch == progress.epoch else f"best {progress.best_epoch}"
            console.print(
                f"epoch {progress.epoch}: loss {figures['loss']:.3f}, FDE@6s {figures[SCORE]:.2f} m, "
                f"{figures['seconds']:.0f} s ({best})"
            )

        folder = run.train(report, tick, console.print)
    console.print(f"checkpoint: {folder}")
