"""``cab-forecast predict``: one request to a running server."""

from pathlib import Path
from typing import Annotated

import typer

from cab_forecast.endpoints import DEFAULT_ENDPOINT
from cli.options import DEFAULT_TIMEOUT, AsJson, Endpoint, Timeout, Token

_MOST = 2**32 - 1


def register(app: typer.Typer) -> None:
    """Adds the command."""
    app.command(name="predict")(predict)


def predict(
    request_file: Annotated[
        str,
        typer.Argument(
            metavar="FILE",
            help="A PredictRequest as .json or .binpb, - for standard input, or demo for a made-up crossing.",
        ),
    ],
    *,
    endpoint: Endpoint = DEFAULT_ENDPOINT,
    token: Token = None,
    timeout: Timeout = DEFAULT_TIMEOUT,
    model: Annotated[str | None, typer.Option(help="name or name@version.")] = None,
    samples: Annotated[
        int | None, typer.Option(min=0, max=_MOST, help="Trajectories to draw an agent.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=_MOST, help="Seed of the samples.")] = None,
    horizon: Annotated[float | None, typer.Option(help="Seconds ahead, a multiple of 0.5.")] = None,
    max_modes: Annotated[
        int | None, typer.Option(min=0, max=_MOST, help="Return the likeliest modes only; 0: all.")
    ] = None,
    all_modes: Annotated[
        bool, typer.Option("--all-modes", help="As the model has them: like ones are not merged.")
    ] = False,
    blind: Annotated[bool, typer.Option("--blind", help="Without map and neighbours.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Fail if any agent cannot be forecast.")] = False,
    plot: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Draw a picture: .png, .svg, .pdf.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write the answer as .json or .binpb.")
    ] = None,
    as_json: AsJson = False,
    save_request: Annotated[
        Path | None,
        typer.Option(dir_okay=False, help="Write the request as .json or .binpb instead of sending it."),
    ] = None,
) -> None:
    """Send one request and show its forecasts; options given here replace those in the request."""
    # Imported here, as in all commands: --help must not wait for it.
    from cli.asking import Server  # noqa: PLC0415
    from cli.prediction import Changes, Outputs, run  # noqa: PLC0415

    changes = Changes(
        model=model,
        samples=samples,
        seed=seed,
        horizon=horizon,
        max_modes=max_modes,
        merge=not all_modes,
        blind=blind,
        strict=strict,
    )
    outputs = Outputs(plot=plot, answer=output, as_json=as_json)
    run(request_file, changes, outputs, save_request, Server(endpoint, token, timeout))
