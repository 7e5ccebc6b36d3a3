"""The program ``cab-forecast``: its options and commands."""

from importlib.metadata import version
from typing import Annotated

import typer

from cli import (
    benchmark,
    consistency,
    convert,
    demo,
    doctor,
    evaluate,
    explain,
    keys,
    maps,
    predict,
    reload,
    replay,
    scenes,
    serve,
    train,
)

app = typer.Typer(
    name="cab-forecast",
    help="Motion forecasting as a service: Gaussian-mixture forecasts of road users.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,  # locals may hold tokens
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cab-forecast {version('cab-forecast')}")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool, typer.Option("--version", help="Print the version.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Declare the options of the whole program."""


serve.register(app)
doctor.register(app)
predict.register(app)
explain.register(app)
maps.register(app)
demo.register(app)
reload.register(app)
replay.register(app)
scenes.register(app)
consistency.register(app)
keys.register(app)
convert.register(app)
train.register(app)
evaluate.register(app)
benchmark.register(app)
