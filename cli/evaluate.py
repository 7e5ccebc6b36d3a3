"""``cab-forecast evaluate``: models on a data set's split, without a server."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.failures import fail

if TYPE_CHECKING:
    from model.evaluation.results import EvaluationResults
    from model.evaluation.run import Evaluation


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("evaluate")(evaluate)


def evaluate(
    data: Annotated[str, typer.Option(help="KIND:PATH of the data, e.g. nuscenes_pred:DIR")],
    out: Annotated[Path, typer.Option(file_okay=False, help="Folder for results.json and tables.md.")],
    split: Annotated[str, typer.Option(help="Split to evaluate on.")] = "train_val",
    protocol: Annotated[
        str,
        typer.Option(
            help="Protocol of inputs and checkpoints: causal, or paper to compare with published tables."
        ),
    ] = "causal",
    models: Annotated[
        Path | None, typer.Option(help="Folder of checkpoints. [default: the bundled ones]")
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(help="NAME,… of checkpoints, baselines or physics-oracle. [default: all]"),
    ] = None,
    ablate: Annotated[
        bool,
        typer.Option("--ablate", help="Also evaluate without the map, without neighbours, without both."),
    ] = False,
    samples: Annotated[
        int, typer.Option(min=0, help="Sampled trajectories per pair; 0: none, and no calibration.")
    ] = 200,
    limit: Annotated[int | None, typer.Option(min=1, help="Evaluate the first LIMIT pairs only.")] = None,
    cache: Annotated[
        Path | None, typer.Option(help="Folder of cached features, shared with train. [default: OUT/cache]")
    ] = None,
) -> None:
    """Evaluate checkpoints, physics models and the Kalman filter on every challenge pair of a split."""
    from cli.display import show_tables  # noqa: PLC0415
    from model.checkpoint import CheckpointError  # noqa: PLC0415 (torch is slow to import)
    from model.data.scenes import DataError  # noqa: PLC0415
    from model.data.sources import READERS, parse_data, parse_protocol  # noqa: PLC0415
    from model.evaluation.run import Evaluation, write_results  # noqa: PLC0415
    from model.evaluation.selection import EvaluationError, select  # noqa: PLC0415
    from model.evaluation.tables import tables  # noqa: PLC0415
    from service.settings import bundled_models  # noqa: PLC0415

    names = [name.strip() for name in (only or "").split(",") if name.strip()]
    if only is not None and not names:
        fail("only: it names nothing")
    try:
        kind, path = parse_data(data)
        inputs = parse_protocol(protocol)
        selection = select(models or bundled_models(), inputs, names)
        reader = READERS[kind](path)
        evaluation = Evaluation(
            selection, kind, reader, split, inputs, cache or out / "cache", samples, limit, ablate
        )
        results = _run(evaluation)
        write_results(results, out)
    except (DataError, CheckpointError, EvaluationError, OSError) as error:
        fail(str(error))
    show_tables(tables(results), out)


def _run(evaluation: "Evaluation") -> "EvaluationResults":
    """Run the evaluation and show its progress."""
    from rich.console import Console  # noqa: PLC0415

    from cli.display import count_up  # noqa: PLC0415

    console = Console(stderr=True)
    with count_up(console) as bar:
        task = bar.add_task("starting", total=None)

        def tick(what: str, done: int) -> None:
            bar.update(task, description=f"{what}: {done} pairs")

        return evaluation(tick, console.print)
