# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for them
"""``cab-forecast predict``: one request to a running server."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.connection import DEFAULT_TIMEOUT, AsJson, Connection, Timeout, connect, with_connection
from cli.failures import fail

if TYPE_CHECKING:
    from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse

DEMO = "demo"
"""The file name that stands for the bundled crossing."""
UINT32_MAX = 2**32 - 1
RequestFile = Annotated[
    str,
    typer.Argument(
        metavar="FILE",
        help="A PredictRequest as .json or .binpb, - for standard input, or demo for a bundled crossing.",
    ),
]
Horizon = Annotated[float | None, typer.Option(help="Seconds ahead, a multiple of 0.5.")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(name="predict")(with_connection(predict))


def predict(
    request_file: RequestFile,
    *,
    connection: Connection,
    timeout: Timeout = DEFAULT_TIMEOUT,
    model: Annotated[str | None, typer.Option(help="name or name@version.")] = None,
    samples: Annotated[
        int | None, typer.Option(min=0, max=UINT32_MAX, help="Sampled trajectories per agent.")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=UINT32_MAX, help="Seed of the samples.")] = None,
    horizon: Horizon = None,
    max_modes: Annotated[
        int | None, typer.Option(min=0, max=UINT32_MAX, help="Return the likeliest modes only; 0: all.")
    ] = None,
    all_modes: Annotated[
        bool, typer.Option("--all-modes", help="Return the model's own modes, without merging similar ones.")
    ] = False,
    blind: Annotated[bool, typer.Option("--blind", help="Forecast without map and neighbours.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Fail if any agent cannot be forecast.")] = False,
    map_file: Annotated[
        str | None,
        typer.Option(
            "--map", metavar="FILE", help="Use this map for the scene, as cab-forecast map writes it."
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Plot the forecasts to a .png, .svg or .pdf file.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Write the response as .json or .binpb.")
    ] = None,
    as_json: AsJson = False,
    save_request: Annotated[
        Path | None,
        typer.Option(dir_okay=False, help="Write the request as .json or .binpb instead of sending it."),
    ] = None,
) -> None:
    """Send one request and show its forecasts; options given here override those in the request."""
    from cab.forecast.v1.prediction_service_pb2 import PredictRequest, SceneRaster
    from cab_forecast.demo import demo_request
    from cli.messages import read_message, write_message

    overrides = _Overrides(
        model=model,
        samples=samples,
        seed=seed,
        horizon=horizon,
        max_modes=max_modes,
        merge=not all_modes,
        blind=blind,
        strict=strict,
    )
    outputs = _Outputs(plot=plot, response=output, as_json=as_json)
    try:
        request = demo_request() if request_file == DEMO else read_message(request_file, PredictRequest())
        overrides.apply(request)
        if map_file is not None:
            raster = read_message(map_file, SceneRaster())
            if not raster.HasField("image"):
                raise ValueError(f"{map_file} holds no SceneRaster: it has no image")
            request.scene_raster.CopyFrom(raster)
        if save_request is not None:
            write_message(save_request, request)
            return
        outputs.check()
        with connect(connection, timeout) as client:
            response = client.predict(request)
        outputs.write(request, response)
    except (OSError, ValueError, ModuleNotFoundError) as error:
        fail(str(error))


@dataclass(frozen=True)
class _Overrides:
    """Options that override the request's; None and False leave it as it is."""

    model: str | None
    samples: int | None
    seed: int | None
    horizon: float | None
    max_modes: int | None
    merge: bool
    """Always overridden: people read merged modes unless they ask for all of them."""
    blind: bool
    strict: bool

    def apply(self, request: "PredictRequest") -> None:
        """Set the options in the request."""
        from cab.forecast.v1.prediction_service_pb2 import CONTEXT_BLIND

        if self.model is not None:
            request.model = self.model
        for name in ("samples", "seed", "horizon", "max_modes"):
            value = getattr(self, name)
            if value is not None:
                setattr(request.options, name, value)
        request.options.merge = self.merge
        if self.blind:
            request.options.context = CONTEXT_BLIND
        if self.strict:
            request.options.strict = True


@dataclass(frozen=True)
class _Outputs:
    """The outputs of a response."""

    plot: Path | None
    response: Path | None
    as_json: bool

    def check(self) -> None:
        """Check before the call that the outputs can be produced after it.

        Raises:
            ModuleNotFoundError: a plot is wanted and matplotlib is not installed.
        """
        if self.plot is not None:
            import cab_forecast.plot  # noqa: F401 (an optional extra)

    def write(self, request: "PredictRequest", response: "PredictResponse") -> None:
        """Write the files and print the table or the JSON.

        Raises:
            OSError: a file cannot be written.
            ValueError: the forecasts cannot be plotted.
        """
        from cab_forecast.show import print_forecasts
        from cli.messages import to_json, write_message

        if self.response is not None:
            write_message(self.response, response)
        if self.plot is not None:
            from cab_forecast.plot import plot

            plot(request, response, self.plot)
        if self.as_json:
            typer.echo(to_json(response))
        else:
            print_forecasts(response, request)
