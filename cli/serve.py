"""``cab-forecast serve``: the server, until it is told to stop."""

import asyncio
import gc
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from cli.failures import fail

if TYPE_CHECKING:
    from service.server import Server
    from service.settings import Settings


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("serve", cls=_ServeCommand)(serve)


class _ServeCommand(TyperCommand):
    """Command whose help lists all settings, not only those that have flags."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Print the help, then the settings."""
        from rich.console import Console  # noqa: PLC0415
        from rich.table import Column, Table  # noqa: PLC0415
        from rich.text import Text  # noqa: PLC0415

        from service.settings_reference import settings_reference  # noqa: PLC0415 (slow to import)

        super().format_help(ctx, formatter)
        variable = Column("Variable", no_wrap=True)
        settings = Table(variable, "Default", "Meaning", title="All settings", box=None, pad_edge=False)
        for setting in settings_reference():
            allowed = f" Allowed: {setting.allowed}." if setting.allowed else ""
            meaning = setting.meaning.replace("``", "") + allowed
            settings.add_row(setting.variable, Text(setting.default or "not set"), Text(meaning))
        Console().print(settings)


def serve(
    http: Annotated[str | None, typer.Option(help="HOST:PORT of REST. [default: 127.0.0.1:8080]")] = None,
    grpc: Annotated[str | None, typer.Option(help="HOST:PORT of gRPC. [default: 127.0.0.1:50051]")] = None,
    store: Annotated[
        str | None,
        typer.Option(
            help="Track memory: memory (this process), redis://…, redis+sentinel://… or redis+cluster://… "
            "[default: memory]"
        ),
    ] = None,
    models: Annotated[
        Path | None, typer.Option(help="Folder of checkpoints. [default: the bundled ones]")
    ] = None,
    default_model: Annotated[
        str | None,
        typer.Option(help="Model for requests that name none. [default: cab if loaded, else kalman]"),
    ] = None,
    allow_paper_protocol: Annotated[
        bool | None,
        typer.Option(
            "--allow-paper-protocol",
            help="Also load models trained with the paper protocol (they warn in every response).",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(help="TOML file of settings. [default: $FORECAST_CONFIG]")
    ] = None,
    log_level: Annotated[
        str | None, typer.Option(help="debug, info, warning or error. [default: info]")
    ] = None,
    log_json: Annotated[bool | None, typer.Option(help="Log JSON lines. [default: text]")] = None,
    demo: Annotated[
        bool,
        typer.Option(
            "--demo", help="Forecast simulated traffic at a junction, and print one forecast of it."
        ),
    ] = False,
) -> None:
    """Serve forecasts over gRPC and REST until SIGTERM or SIGINT.

    Every setting is also an environment variable: FORECAST_HTTP, FORECAST_API_TOKENS and so on. Flags
    override the environment, and the environment overrides the file.
    """
    from service.settings import SettingsError, load  # noqa: PLC0415 (slow to import)

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
    from service.server import ServeError, Server, StartError  # noqa: PLC0415
    from service.telemetry import logs  # noqa: PLC0415

    logs.configure(settings.log_level, settings.log_json)

    with ExitStack() as until_end:

        async def main() -> None:
            server = Server(settings)
            await server.run(lambda started: _when_ready(started, until_end if demo else None))

        try:
            with asyncio.Runner(loop_factory=_loop_factory()) as runner:
                runner.run(main())
        except (StartError, ServeError) as error:
            fail(str(error))


def _when_ready(server: "Server", demo: ExitStack | None) -> None:
    # Everything allocated so far lives until the end; exempt it from garbage collection, which delays calls
    gc.collect()
    gc.freeze()
    if demo is not None:
        _show_demo(server, demo)


def _loop_factory() -> "type[asyncio.AbstractEventLoop] | None":
    """Return uvloop's loop, or None for asyncio's own on platforms that uvloop does not support."""
    try:
        import uvloop  # noqa: PLC0415
    except ImportError:
        return None
    return uvloop.Loop


def _show_demo(server: "Server", until_end: ExitStack) -> None:
    """Forecast the bundled scene through the public client and print it, then let it move.

    Args:
        server: the server, which is ready.
        until_end: what ends with the server.
    """
    from cab_forecast import Client, ForecastError  # noqa: PLC0415
    from cab_forecast.demo import demo_request  # noqa: PLC0415
    from cab_forecast.show import print_forecasts  # noqa: PLC0415
    from cli.demo import running_demo  # noqa: PLC0415

    settings = server.settings
    if settings.tls_certificate is not None or settings.keys_file is not None:
        typer.secho("demo: not shown by a server with TLS or a file of keys", err=True)
        return
    token = settings.api_tokens[0].get_secret_value() if settings.api_tokens else None
    until_end.enter_context(running_demo(server.grpc_address, token))
    request = demo_request()
    try:
        with Client(server.grpc_address, token=token) as client:
            response = client.predict(request)
    except ForecastError as error:
        typer.secho(f"demo: {error}", fg=typer.colors.RED, err=True)
        return
    print_forecasts(response, request)
    typer.echo(f"Traffic moves at a simulated junction: open http://{server.http_address}/ (Ctrl-C ends)")
