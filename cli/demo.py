# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for them
"""``cab-forecast demo``: moving traffic that a server forecasts."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.connection import Connection, connect, with_connection
from cli.failures import fail

if TYPE_CHECKING:
    from cab_forecast.demo.live import Progress
    from cab_forecast.demo.ticks import Recording, Ticks
    from model.data.nuscenes_pred import NuscenesPredReader

DEFAULT_SCENE = "junction"
_RECORDED = "nuscenes_pred"
_RECORDED_SPLIT = "train_val"
_TIMEOUT = 1.0
"""s for a call; a forecast that comes later is of no use to a scene that moves."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(with_connection(demo))


def demo(
    *,
    connection: Connection,
    scene: Annotated[
        str, typer.Option(help="junction, roundabout, highway, or nuscenes_pred:DIR for recorded scenes.")
    ] = DEFAULT_SCENE,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="Duration. [default: until Ctrl-C]")] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.5, max=50.0, help="Ticks a second. [default: 10; recorded: 2]")
    ] = None,
    agents: Annotated[
        int | None, typer.Option(min=1, max=200, help="About how many road users. [default: the scene's own]")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the traffic.")] = 0,
    attached: Annotated[bool, typer.Option("--attached", hidden=True)] = False,
) -> None:
    """Let a server forecast moving traffic, tick by tick, and watch it in the server's console (/).

    Traffic is simulated, and the same for the same seed. Recorded scenes are replayed with their maps, one
    after the other, at the 2 Hz at which they were annotated: nothing is interpolated.
    """
    from cab_forecast.demo.live import play

    ticks = _ticks(scene, rate, agents, seed)
    if attached:
        _end_with_standard_input()
    try:
        with connect(connection, _TIMEOUT, retries=0) as client:
            for progress in play(client, ticks, seconds):
                if not attached:
                    typer.echo(_line(progress), err=progress.error is not None)
    except KeyboardInterrupt:
        if not attached:
            typer.echo("demo: ended")


def _ticks(scene: str, rate: float | None, agents: int | None, seed: int) -> "Ticks":
    """Return the scene that an option names."""
    from cab_forecast.demo.scenes import SCENES
    from cab_forecast.demo.simulation import Simulation
    from cab_forecast.demo.ticks import SimulatedTicks

    kind, _, folder = scene.partition(":")
    if kind == _RECORDED and folder:
        if rate not in (None, 2.0) or agents is not None:
            fail("--rate and --agents: recorded scenes have 2 ticks a second and the agents that were there")
        return _recorded(Path(folder))
    if scene not in SCENES:
        fail(f"--scene: {scene!r} is not one of {', '.join(SCENES)} and {_RECORDED}:DIR")
    return SimulatedTicks(Simulation(SCENES[scene](), seed, agents), rate or 10.0)


def _recorded(folder: Path) -> "Ticks":
    """Return the scenes of the prediction challenge's validation split."""
    from cab_forecast.demo.ticks import RecordedTicks
    from model.data.nuscenes_pred import NuscenesPredReader
    from model.data.scenes import DataError

    scenes = _read(NuscenesPredReader(folder))
    try:
        first = next(scenes)  # says at once what is wrong with the folder
    except DataError as error:
        fail(str(error))
    return RecordedTicks(chain([first], scenes))


def _read(reader: "NuscenesPredReader") -> "Iterator[Recording]":
    """Yield the recorded scenes, each read when it is its turn."""
    from cab_forecast.demo.ticks import RecordedTrack, Recording
    from cab_forecast.requests import scene_raster

    for record in reader.scenes(_RECORDED_SPLIT):
        tracks = (
            RecordedTrack(each.id, each.type.value, each.frames, each.position, each.heading)
            for each in record.tracks
        )
        raster = record.raster
        message = scene_raster(raster.layers != 0, raster.origin.tolist(), raster.pixels_per_meter)
        yield Recording(f"{_RECORDED}/{record.name}", tuple(tracks), message)


def _line(progress: "Progress") -> str:
    """Return what was done in a second, on one line."""
    if progress.error is not None:
        return f"demo: no forecast: {progress.error}"
    median = sorted(progress.seconds)[len(progress.seconds) // 2] if progress.seconds else 0.0
    skipped = f", {progress.skipped} ticks skipped" if progress.skipped else ""
    agents = f"{progress.agents} agent{'s' * (progress.agents != 1)}"
    return f"{agents}, {progress.calls} forecasts, {1e3 * median:.0f} ms each{skipped}"


@contextmanager
def running_demo(endpoint: str, token: str | None) -> Iterator[None]:
    """Run the demo in a process of its own until the block ends, or this process does.

    Args:
        endpoint: the server.
        token: API key or bearer token; None: none.
    """
    environment = os.environ | ({} if token is None else {"CAB_FORECAST_TOKEN": token})
    command = [sys.executable, "-P", "-m", "cli", "demo", "--endpoint", endpoint, "--attached"]
    # A session of its own, so that Ctrl-C reaches the server alone, which ends the demo
    with subprocess.Popen(  # noqa: S603 - ourselves
        command, stdin=subprocess.PIPE, env=environment, start_new_session=True
    ) as process:
        try:
            yield
        finally:
            process.terminate()


def _end_with_standard_input() -> None:
    """End this process when its standard input closes: when the server that started it is gone."""

    def wait() -> None:
        sys.stdin.buffer.read()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True, name="attached").start()
