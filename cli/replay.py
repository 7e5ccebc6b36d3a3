# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for them
"""``cab-forecast replay``: recorded calls to another server or model."""

import json
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.connection import Connection, Timeout, connect, with_connection
from cli.failures import fail

if TYPE_CHECKING:
    from cab_forecast.replay import Replayed

_TOLERANCE = 1e-4
_TIMEOUT = 30.0
_MAX_LINES = 20
"""Max number of calls that are listed."""
_MAX_OTHERS = 3
"""Max number of differences in words that are listed for a call."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("replay")(with_connection(replay))


def replay(
    recording: Annotated[
        Path, typer.Argument(metavar="FILE", help="An .mcap file that a server with FORECAST_RECORD wrote.")
    ],
    *,
    connection: Connection,
    timeout: Timeout = _TIMEOUT,
    model: Annotated[
        str | None,
        typer.Option(help="name or name@version. [default: the model and version that answered then]"),
    ] = None,
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Largest difference that counts as none: m, or of a weight.")
    ] = _TOLERANCE,
    limit: Annotated[int | None, typer.Option(min=1, help="Send the first calls only, this many.")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a line of JSON for each call instead of a summary.")
    ] = False,
) -> None:
    """Send recorded calls to a server and say what it answers differently.

    Histories that came from the track memory and drawn seeds are sent along; no scene is named, so nothing is
    remembered. Ends with code 1 if a difference is beyond the tolerance.
    """
    from cab_forecast.replay import replay as replayed_calls

    try:
        from cab_forecast.recordings import read_recording
    except ModuleNotFoundError as error:
        fail(str(error))
    summary = _Summary(tolerance)
    with connect(connection, timeout) as client:
        for replayed in replayed_calls(client, islice(read_recording(recording), limit), model):
            summary.add(replayed)
            if as_json:
                typer.echo(_to_json(replayed))
            elif summary.differing <= _MAX_LINES and not replayed.difference.within(tolerance):
                typer.echo(f"call {summary.calls}: {_to_text(replayed)}")
    if not as_json:
        typer.echo(summary.text())
    if summary.differing:
        raise typer.Exit(1)


class _Summary:
    """The largest differences of a replay."""

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self.calls = 0
        self.differing = 0
        """Number of calls with a difference beyond the tolerance."""
        self._agents = 0
        self._position_m = 0.0
        self._weight = 0.0
        self._sigma_m = 0.0

    def add(self, replayed: "Replayed") -> None:
        """Add a call."""
        difference = replayed.difference
        self.calls += 1
        self.differing += not difference.within(self._tolerance)
        self._agents += difference.agents
        self._position_m = max(self._position_m, difference.position_m)
        self._weight = max(self._weight, difference.weight)
        self._sigma_m = max(self._sigma_m, difference.sigma_m)

    def text(self) -> str:
        """Return the summary in words."""
        return (
            f"{self.calls} calls, {self._agents} forecasts: {self.differing} calls differ by more than "
            f"{self._tolerance:g}; at most {self._position_m:.3g} m in positions, {self._weight:.3g} in "
            f"weights, {self._sigma_m:.3g} m in standard deviations"
        )


def _to_text(replayed: "Replayed") -> str:
    difference = replayed.difference
    words = [
        f"time {replayed.call.request.time:.3f}",
        f"positions {difference.position_m:.3g} m",
        f"weights {difference.weight:.3g}",
        f"standard deviations {difference.sigma_m:.3g} m",
        *difference.others[:_MAX_OTHERS],
    ]
    if len(difference.others) > _MAX_OTHERS:
        words.append(f"and {len(difference.others) - _MAX_OTHERS} more")
    return ", ".join(words)


def _to_json(replayed: "Replayed") -> str:
    request, difference = replayed.call.request, replayed.difference
    return json.dumps(
        {
            "scene_id": request.scene_id,
            "time": request.time,
            "agents": difference.agents,
            "position_m": difference.position_m,
            "weight": difference.weight,
            "sigma_m": difference.sigma_m,
            "others": difference.others,
        }
    )
