"""What ``cab-forecast predict`` does: read, send, show."""

from dataclasses import dataclass
from pathlib import Path

import typer

from cab.forecast.v1.prediction_service_pb2 import CONTEXT_BLIND, PredictRequest, PredictResponse
from cab_forecast.demo import demo_request
from cab_forecast.show import print_forecasts
from cli.asking import Server, asking
from cli.failures import fail
from cli.messages import read_message, to_json, write_message

DEMO = "demo"
"""Stands for the made-up crossing where a file is expected."""


@dataclass(frozen=True)
class Changes:
    """What the command line says instead of the request; None and False leave it as it is."""

    model: str | None
    samples: int | None
    seed: int | None
    horizon: float | None
    max_modes: int | None
    merge: bool
    """Always said: what a person reads is merged, unless all modes are asked for."""
    blind: bool
    strict: bool

    def apply(self, request: PredictRequest) -> None:
        """Puts them into the request."""
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
class Outputs:
    """Where the answer goes, besides the terminal."""

    plot: Path | None
    answer: Path | None
    as_json: bool

    def prepare(self) -> None:
        """Finds out before the call what would fail after it.

        Raises:
            ModuleNotFoundError: a picture is wanted and matplotlib is not installed.
        """
        if self.plot is not None:
            import cab_forecast.plot  # noqa: F401, PLC0415 - an optional extra

    def write(self, request: PredictRequest, response: PredictResponse) -> None:
        """Writes the files and prints the table, or the JSON.

        Raises:
            OSError: a file cannot be written.
            ValueError: the picture cannot be drawn.
        """
        if self.answer is not None:
            write_message(self.answer, response)
        if self.plot is not None:
            from cab_forecast.plot import plot  # noqa: PLC0415

            plot(request, response, self.plot)
        if self.as_json:
            typer.echo(to_json(response))
        else:
            print_forecasts(response, request)


def run(
    source: str,
    changes: Changes,
    outputs: Outputs,
    save_request: Path | None,
    server: Server,
) -> None:
    """Reads the request, changes it, and sends it; or writes it to ``save_request`` and sends nothing.

    Raises:
        typer.Exit: with code 1 and one line on standard error, when there is no answer.
    """
    try:
        request = demo_request() if source == DEMO else read_message(source, PredictRequest())
        changes.apply(request)
        if save_request is not None:
            write_message(save_request, request)
            return
        outputs.prepare()
        with asking(server) as client:
            response = client.predict(request)
        outputs.write(request, response)
    except (OSError, ValueError, ModuleNotFoundError) as error:
        fail(str(error))
