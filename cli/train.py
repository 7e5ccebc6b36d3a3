"""``cab-forecast train``."""

from pathlib import Path
from typing import Annotated

import typer

from cli.failures import fail


def register(app: typer.Typer) -> None:
    """Adds the command."""

    @app.command()
    def train(
        method: Annotated[
            str,
            typer.Argument(
                help="cab, trajectron, trajectron-no-context, reweight, rubiz, halentnet, "
                "halentnet-no-context or covernet"
            ),
        ],
        data: Annotated[str, typer.Option(help="KIND:PATH of the data, e.g. nuscenes_pred:DIR")],
        out: Annotated[Path, typer.Option(help="Folder of the run; an interrupted run goes on there.")],
        protocol: Annotated[str, typer.Option(help="causal, or paper to compare with tables")] = "causal",
        train_split: Annotated[str, typer.Option(help="Split to train on.")] = "train",
        validation_split: Annotated[str, typer.Option(help="Split to choose the epoch by.")] = "train_val",
        also: Annotated[
            list[str] | None,
            typer.Option(help="KIND:PATH@SPLIT of more pairs to train on; may be repeated."),
        ] = None,
        report_split: Annotated[
            str | None, typer.Option(help="Split of the card's figures; default: the validation split.")
        ] = None,
        cache: Annotated[Path | None, typer.Option(help="Folder of caches; default: OUT/cache.")] = None,
        config: Annotated[Path | None, typer.Option(help="TOML; default: the method's own.")] = None,
        published: Annotated[
            bool,
            typer.Option("--published", help="Objective, rates and epochs of the authors' released code."),
        ] = False,
        epochs: Annotated[int | None, typer.Option(min=1, help="Goes before the TOML's.")] = None,
        learning_rate: Annotated[float | None, typer.Option(help="Goes before the TOML's.")] = None,
        seed: Annotated[int | None, typer.Option(help="Goes before the TOML's.")] = None,
        cooldown_epochs: Annotated[
            int | None, typer.Option(min=0, help="The last epochs, over which the learning rate goes to 0.")
        ] = None,
        start: Annotated[Path | None, typer.Option(help="Checkpoint whose parameters to begin with.")] = None,
        version: Annotated[
            str | None,
            typer.Option(help="Of the checkpoint; default 1.0.0, or 1.0.0+paper by that protocol."),
        ] = None,
    ) -> None:
        """Trains a method and writes its best epoch as a checkpoint that serve loads."""
        from cli.training import show_training  # noqa: PLC0415
        from model.checkpoint import CheckpointError, load_checkpoint  # noqa: PLC0415 (torch is slow to import)
        from model.data.scenes import DataError  # noqa: PLC0415
        from model.data.sources import parse_also, parse_data, parse_protocol  # noqa: PLC0415
        from model.forecaster import Protocol  # noqa: PLC0415
        from model.training.config import TrainingError, load_config, parse_method  # noqa: PLC0415
        from model.training.run import Run, Source  # noqa: PLC0415

        changes: dict[str, object] = {"epochs": epochs, "learning_rate": learning_rate, "seed": seed}
        changes["cooldown_epochs"] = cooldown_epochs
        try:
            begun = None if start is None else load_checkpoint(start)
            if begun is not None:
                changes["start"] = f"{begun.info.full_name} ({begun.info.protocol.value})"
            kind, path = parse_data(data)
            source = Source(
                kind,
                path,
                train_split,
                validation_split,
                parse_protocol(protocol),
                report_split,
                tuple(parse_also(one) for one in also or ()),
            )
            default = "1.0.0+paper" if source.protocol is Protocol.PAPER else "1.0.0"
            settings = load_config(parse_method(method), config, published=published, **changes)
            show_training(Run(settings, source, out, cache or out / "cache", version or default, begun))
        except (TrainingError, DataError, CheckpointError) as error:
            fail(str(error))
