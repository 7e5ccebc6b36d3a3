"""``cab-forecast train``."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.failures import fail


def register(app: typer.Typer) -> None:
    """Adds the command."""

    @app.command()
    def train(
        method: Annotated[
            str, typer.Argument(help="cab, trajectron, trajectron-no-context, reweight or rubiz")
        ],
        data: Annotated[str, typer.Option(help="KIND:PATH of the data, e.g. nuscenes_pred:DIR")],
        out: Annotated[Path, typer.Option(help="Folder of the run; an interrupted run goes on there.")],
        protocol: Annotated[str, typer.Option(help="causal, or paper to compare with tables")] = "causal",
        train_split: Annotated[str, typer.Option(help="Split to train on.")] = "train",
        validation_split: Annotated[str, typer.Option(help="Split to choose the epoch by.")] = "train_val",
        cache: Annotated[Path | None, typer.Option(help="Folder of caches; default: OUT/cache.")] = None,
        config: Annotated[Path | None, typer.Option(help="TOML; default: the method's own.")] = None,
        epochs: Annotated[int | None, typer.Option(min=1, help="Goes before the TOML's.")] = None,
        learning_rate: Annotated[float | None, typer.Option(help="Goes before the TOML's.")] = None,
        seed: Annotated[int | None, typer.Option(help="Goes before the TOML's.")] = None,
        version: Annotated[str, typer.Option(help="Of the checkpoint.")] = "1.0.0",
    ) -> None:
        """Trains a method and writes its best epoch as a checkpoint that serve loads."""
        from model.data.scenes import DataError  # noqa: PLC0415 (torch is slow to import)
        from model.training.config import TrainingError, load_config, parse_method  # noqa: PLC0415
        from model.training.run import Run, Source, parse_data, parse_protocol  # noqa: PLC0415
        from service.cli.training import show_training  # noqa: PLC0415

        changes = {"epochs": epochs, "learning_rate": learning_rate, "seed": seed}
        try:
            kind, path = parse_data(data)
            source = Source(kind, path, train_split, validation_split, parse_protocol(protocol))
            settings = load_config(parse_method(method), config, **changes)
            show_training(Run(settings, source, out, cache or out / "cache", version))
        except (TrainingError, DataError) as error:
            fail(str(error))
