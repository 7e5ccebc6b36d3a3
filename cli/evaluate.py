"""``cab-forecast evaluate``."""

from pathlib import Path
from typing import Annotated

import typer

from cli.failures import fail


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command("evaluate")(evaluate)


def evaluate(
    data: Annotated[str, typer.Option(help="KIND:PATH of the data, e.g. nuscenes_pred:DIR")],
    out: Annotated[Path, typer.Option(file_okay=False, help="Folder for results.json and tables.md.")],
    split: Annotated[str, typer.Option(help="Split to judge on.")] = "train_val",
    protocol: Annotated[
        str, typer.Option(help="causal, or paper to compare with tables; of the inputs and the checkpoints")
    ] = "causal",
    models: Annotated[
        Path | None, typer.Option(help="Folder of checkpoints. [default: the bundled ones]")
    ] = None,
    only: Annotated[
        str | None, typer.Option(help="NAME,… of checkpoints, baselines, physics-oracle. [default: all]")
    ] = None,
    ablate: Annotated[
        bool,
        typer.Option("--ablate", help="Also judge checkpoints with the map, the neighbours, both gone."),
    ] = False,
    samples: Annotated[
        int, typer.Option(min=0, help="Trajectories drawn a pair; 0: none, and no calibration.")
    ] = 200,
    limit: Annotated[int | None, typer.Option(min=1, help="Only so many of the first pairs.")] = None,
    cache: Annotated[
        Path | None, typer.Option(help="Folder of caches, as train's. [default: OUT/cache]")
    ] = None,
) -> None:
    """Judges checkpoints beside physics and Kalman on every challenge pair of a split, without a server."""
    from cli.evaluation import show_evaluation  # noqa: PLC0415
    from cli.tables import show_tables  # noqa: PLC0415
    from model.checkpoint import CheckpointError  # noqa: PLC0415 (torch is slow to import)
    from model.data.scenes import DataError  # noqa: PLC0415
    from model.data.sources import READERS, parse_data, parse_protocol  # noqa: PLC0415
    from model.evaluation.run import Evaluation, write_results  # noqa: PLC0415
    from model.evaluation.subjects import EvaluationError, choose  # noqa: PLC0415
    from model.evaluation.tables import tables  # noqa: PLC0415
    from service.settings import bundled_models  # noqa: PLC0415

    names = [name.strip() for name in (only or "").split(",") if name.strip()]
    if only is not None and not names:
        fail("only: it names nothing")
    try:
        kind, path = parse_data(data)
        inputs = parse_protocol(protocol)
        subjects = choose(models or bundled_models(), inputs, names)
        reader = READERS[kind](path)
        evaluation = Evaluation(
            subjects, kind, reader, split, inputs, cache or out / "cache", samples, limit, ablate
        )
        results = show_evaluation(evaluation)
        write_results(results, out)
    except (DataError, CheckpointError, EvaluationError, OSError) as error:
        fail(str(error))
    show_tables(tables(results), out)
