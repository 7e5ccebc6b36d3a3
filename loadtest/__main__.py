"""Load tests of a server: ``python -m loadtest SCENARIO``.

The clients run in this process and the server in another one. The exit status is 1 if a call was lost, if an
answer differs from the forward in process, or if the scenario found another problem.
"""

import asyncio
import os
import platform
from pathlib import Path
from typing import Annotated

import typer

import model
from loadtest.report import Report
from loadtest.requests import Encoding, Map
from loadtest.scenarios import SCENARIOS
from loadtest.session import Options, opened
from loadtest.wire import Transport

_SOAK_SECONDS = 600.0
_SECONDS = 30.0


async def run(names: list[str], options: Options) -> Report:
    """Run scenarios in one session."""
    async with opened(options) as session:
        for name in names:
            await SCENARIOS[name](session)
        body = len(session.requests[0].body)
    setup = [
        f"model {options.model}, {options.agents} agents a call, all modes, {options.transport}, "
        f"{options.encoding}, requests of {body} bytes with the map as {options.map}",
        f"{'Poisson' if options.poisson else 'even'} arrivals; latencies count from the scheduled time",
        f"{os.cpu_count()} cores, {platform.machine()}; server and clients share this machine"
        if session.owns_server
        else f"{os.cpu_count()} cores of the clients; the server ran elsewhere",
    ]
    return Report(f"Load test: {', '.join(names)}", setup, session.results, session.notes)


def main(
    scenario: Annotated[list[str], typer.Argument(help=f"one or more of {', '.join(SCENARIOS)}; or all")],
    rate: Annotated[
        float | None, typer.Option(min=0, help="offered calls/s; default: a share of the measured peak")
    ] = None,
    peak: Annotated[float | None, typer.Option(help="peak, calls/s; default: measured")] = None,
    seconds: Annotated[
        float | None, typer.Option(help=f"duration of a run; default: {_SECONDS:g}, soak {_SOAK_SECONDS:g}")
    ] = None,
    agents: Annotated[int, typer.Option(min=1, help="vehicles a call")] = 32,
    deadline: Annotated[
        float | None, typer.Option(help="seconds; default: 1, overload: 0.1, 1 and none in turn")
    ] = None,
    transport: Annotated[Transport, typer.Option()] = Transport.GRPC,
    encoding: Annotated[Encoding, typer.Option(help="of the bodies over REST")] = Encoding.PROTOBUF,
    form: Annotated[
        Map, typer.Option("--map", help="the whole raster in each call, or its digest")
    ] = Map.RASTER,
    name: Annotated[str, typer.Option("--model", help="requested model")] = "cab",
    models: Annotated[
        Path | None, typer.Option(help="folder of checkpoints; default: the bundled one")
    ] = None,
    even: Annotated[bool, typer.Option("--even", help="calls at even intervals, not Poisson")] = False,
    endpoint: Annotated[
        str | None, typer.Option(help="HOST:PORT of a running server's gRPC; default: a server is started")
    ] = None,
    http: Annotated[
        str | None, typer.Option(help="HOST:PORT of its REST, for its metrics and with --transport rest")
    ] = None,
    setting: Annotated[
        list[str] | None, typer.Option(help="NAME=VALUE of the started server, e.g. threads=1")
    ] = None,
    uploads: Annotated[int, typer.Option(help="slow uploads")] = 300,
    half_headers: Annotated[int, typer.Option(help="connections that never end their headers")] = 1000,
    readers: Annotated[int, typer.Option(help="clients that never read their responses")] = 100,
    out: Annotated[Path | None, typer.Option(help="folder for report.md and report.html")] = None,
) -> None:
    """Run scenarios one after the other, and print the report."""
    names = list(SCENARIOS) if scenario == ["all"] else scenario
    for unknown in [one for one in names if one not in SCENARIOS]:
        raise typer.BadParameter(f"there is no scenario {unknown}; there are {', '.join(SCENARIOS)} and all")
    if endpoint is not None and http is None:
        raise typer.BadParameter("--endpoint needs --http, whose metrics are read")
    if transport is Transport.GRPC and encoding is Encoding.JSON:
        raise typer.BadParameter("gRPC has no JSON; add --transport rest")
    options = Options(
        models or Path(next(iter(model.__path__))) / "checkpoints",
        name,
        agents,
        seconds or (_SOAK_SECONDS if names == ["soak"] else _SECONDS),
        rate,
        peak,
        deadline=deadline,
        transport=transport,
        encoding=encoding,
        map=form,
        poisson=not even,
        grpc=endpoint,
        http=http,
        uploads=uploads,
        half_headers=half_headers,
        readers=readers,
        settings=dict(one.split("=", 1) for one in setting or ()),
    )
    report = asyncio.run(run(names, options))
    typer.echo(report.markdown())
    if out is not None:
        report.write(out)
    raise typer.Exit(1 if report.failures else 0)


app = typer.Typer(add_completion=False)
app.command()(main)

if __name__ == "__main__":
    app()
