"""``cab-forecast serve``."""

import asyncio
import gc
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.failures import fail

if TYPE_CHECKING:
    from service.server import Server
    from service.settings import Settings


def register(app: typer.Typer) -> None:
    """Adds the command to the program."""
    app.command("serve")(serve)


def serve(
    http: Annotated[str | None, typer.Option(help="HOST:PORT of REST. [default: 127.0.0.1:8080]")] = None,
    grpc: Annotated[str | None, typer.Option(help="HOST:PORT of gRPC. [default: 127.0.0.1:50051]")] = None,
    store: Annotated[
        str | None,
        typer.Option(
            help="Where agents are remembered: memory, redis://…, redis+sentinel://…, redis+cluster://… "
            "[default: memory]"
        ),
    ] = None,
    models: Annotated[
        Path | None, typer.Option(help="Folder of checkpoints. [default: the bundled ones]")
    ] = None,
    default_model: Annotated[
        str | None,
        typer.Option(help="Model of requests that name none. [default: cab if loaded, else kalman]"),
    ] = None,
    allow_paper_protocol: Annotated[
        bool | None,
        typer.Option(
            "--allow-paper-protocol",
            help="Load models trained by the paper protocol, too (they warn in every answer).",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="TOML file of settings. [default: $FORECAST_CONFIG]")
    ] = None,
    log_level: Annotated[
        str | None, typer.Option(help="debug, info, warning or error. [default: info]")
    ] = None,
    log_json: Annotated[bool | None, typer.Option(help="Logs as JSON lines. [default: for people]")] = None,
    demo: Annotated[
        bool, typer.Option("--demo", help="Once ready, forecast the bundled scene through gRPC and print it.")
    ] = False,
) -> None:
    """Serves forecasts over gRPC and REST until SIGTERM or SIGINT.

    Every setting is an environment variable, too: FORECAST_HTTP, FORECAST_API_TOKENS and so on. Flags go
    before the environment, and the environment before the file.
    """
    from service.settings import SettingsError, load  # noqa: PLC0415 - heavy, and other commands do without

    try:
        settings = load(
            config,
            http=http,
            grpc=grpc,
            store=store,
            models=models,
            default_model=default_model,
            allow_paper_protocol=allow_paper_protocol,
            log_level=log_level,
            log_json=log_json,
        )
    except SettingsError as error:
        fail(str(error))
    _serve(settings, demo)


def _serve(settings: "Settings", demo: bool) -> None:
    from service.server import Server, StartError  # noqa: PLC0415
    from service.telemetry import logs  # noqa: PLC0415

    logs.configure(settings.log_level, settings.log_json)

    async def main() -> None:
        server = Server(settings)
        await server.run(lambda started: _when_ready(started, demo))

    try:
        with asyncio.Runner(loop_factory=_loop_factory()) as runner:
            runner.run(main())
    except StartError as error:
        fail(str(error))


def _when_ready(server: "Server", demo: bool) -> None:
    # What is there now stays: to look through it again and again for garbage would cost calls their time
    gc.collect()
    gc.freeze()
    if demo:
        _show_demo(server)


def _loop_factory() -> "type[asyncio.AbstractEventLoop] | None":
    """uvloop where it is there: it is quicker, and not made for every platform."""
    try:
        import uvloop  # noqa: PLC0415
    except ImportError:
        return None
    return uvloop.Loop


def _show_demo(server: "Server") -> None:
    """Forecasts the bundled scene as any client would, and prints it."""
    from cab_forecast import Client, ForecastError  # noqa: PLC0415
    from cab_forecast.demo import demo_request  # noqa: PLC0415
    from cab_forecast.show import print_forecasts  # noqa: PLC0415

    tokens = server.settings.api_tokens
    request = demo_request()
    try:
        with Client(server.grpc_address, token=tokens[0].get_secret_value() if tokens else None) as client:
            response = client.predict(request)
    except ForecastError as error:
        typer.secho(f"demo: {error}", fg=typer.colors.RED, err=True)
        return
    print_forecasts(response, request)
