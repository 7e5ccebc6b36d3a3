"""Servers in processes of their own."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def process(*arguments: str, **settings: object) -> Iterator["subprocess.Popen[str]"]:
    """A server on free ports.

    Args:
        arguments: of ``cab-forecast serve``.
        settings: others, by name.
    """
    command = [sys.executable, "-m", "service", "serve", "--http", "127.0.0.1:0", "--grpc", "127.0.0.1:0"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("FORECAST_")}
    environment["FORECAST_WORKERS"] = os.environ["FORECAST_WORKERS"]
    environment |= {f"FORECAST_{name.upper()}": str(value) for name, value in settings.items()}
    with subprocess.Popen(  # noqa: S603 - ourselves
        [*command, *arguments], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as started:
        try:
            yield started
        finally:
            started.kill()


def ready(started: "subprocess.Popen[str]") -> tuple[str, str]:
    """HTTP and gRPC addresses, once it is ready."""
    assert started.stderr is not None
    for line in started.stderr:
        entry = json.loads(line)
        if entry["event"] == "ready":
            return entry["http"], entry["grpc"]
    raise AssertionError("it ended before it was ready")
