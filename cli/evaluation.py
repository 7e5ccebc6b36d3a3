"""An evaluation on the terminal: how far it is."""

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from model.evaluation.results import Results
from model.evaluation.run import Evaluation


def show_evaluation(evaluation: Evaluation) -> Results:
    """Runs it, and shows how it goes.

    Raises:
        DataError: the data is bad, or the split unknown.
    """
    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    bar = Progress(*columns, console=console, transient=True)
    with bar:
        task = bar.add_task("starting", total=None)

        def tick(what: str, done: int) -> None:
            bar.update(task, description=f"{what}: {done} pairs")

        return evaluation(tick, console.print)
