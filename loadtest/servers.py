"""Servers for measurements, each a process of its own on free ports."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_START_SECONDS = 120.0
_STOP_SECONDS = 30.0
_SETTING = "FORECAST_"
_ANY_PORT = "127.0.0.1:0"


@dataclass(frozen=True)
class Server:
    """Server process that is ready."""

    http: str
    """HOST:PORT of REST."""
    grpc: str
    """HOST:PORT of gRPC."""
    seconds: float
    """Seconds from the start of the process until it was ready."""
    process: "subprocess.Popen[bytes]"
    log: Path

    def errors(self) -> list[str]:
        """Return the events that the server has logged as errors."""
        return [event["event"] for event in _events(self.log) if event["level"] in ("error", "critical")]


@contextmanager
def serving(
    models: Path, http: str = _ANY_PORT, grpc: str = _ANY_PORT, **settings: object
) -> Iterator[Server]:
    """Run a server; settings in this process's environment do not reach it.

    Args:
        models: folder of its checkpoints; if it is empty, the server has the baselines only.
        http: HOST:PORT of REST.
        grpc: HOST:PORT of gRPC.
        settings: settings of ``service.settings.Settings``.

    Raises:
        RuntimeError: the server did not start.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_SETTING)}
    environment |= {_SETTING + name.upper(): str(value) for name, value in settings.items()}
    ports = ["--http", http, "--grpc", grpc]
    command = [sys.executable, "-m", "service", "serve", "--models", str(models), "--log-json", *ports]
    with tempfile.TemporaryDirectory(prefix="loadtest-") as folder:
        log = Path(folder) / "log"
        with log.open("wb") as output:  # a file: a pipe that nobody reads would fill up
            begin = time.perf_counter()
            process = subprocess.Popen(command, env=environment, stderr=subprocess.STDOUT, stdout=output)  # noqa: S603
        try:
            ready = _until_ready(process, log, begin + _START_SECONDS)
            yield Server(ready["http"], ready["grpc"], time.perf_counter() - begin, process, log)
        finally:
            end(process, _STOP_SECONDS)


def end(process: "subprocess.Popen[bytes]", seconds: float) -> None:
    """Terminate a process, and kill it if it has not ended after some seconds."""
    process.terminate()
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def random_checkpoint(folder: Path) -> None:
    """Save a full-size CAB checkpoint with random weights."""
    from loadtest.forward import cab_network  # noqa: PLC0415 (torch is slow to import)
    from model.checkpoint import save_checkpoint  # noqa: PLC0415

    model = cab_network()
    save_checkpoint(
        folder / "cab", model.info, model.config, model.networks.state_dict(), "Random weights, to measure."
    )


def _until_ready(process: "subprocess.Popen[bytes]", log: Path, give_up: float) -> dict[str, str]:
    """Return the server's "ready" event."""
    while process.poll() is None and time.perf_counter() < give_up:
        for event in _events(log):
            if event["event"] == "ready":
                return event
        time.sleep(0.002)
    raise RuntimeError(f"the server did not start: {log.read_text()}")


def _events(log: Path) -> list[dict[str, str]]:
    """Return the JSON events of a log, without a last line that is still incomplete."""
    lines = log.read_text().splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.startswith("{") and line.endswith("\n")]
