"""Programs of the system tests: HAProxy, Prometheus."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from loadtest.servers import end

_STOP_SECONDS = 10.0


def require(name: str) -> str:
    """Return the path of a program.

    Where it is missing, the test fails in CI, which can install it, and is skipped elsewhere.
    """
    found = shutil.which(name, path=os.environ.get("PATH", "") + ":/usr/sbin")
    if found is None:
        text = f"{name} is not installed; Debian has it: apt-get install {name}"
        if os.environ.get("CI"):
            pytest.fail(text)
        pytest.skip(text)
    return found


@contextmanager
def program(name: str, *arguments: str, cwd: Path | None = None) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a program; its output is shown if it has ended by itself."""
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(  # noqa: S603
            [require(name), *arguments], cwd=cwd, stdout=output, stderr=subprocess.STDOUT
        )
        try:
            yield process
        finally:
            ended = process.poll()
            end(process, _STOP_SECONDS)
            output.seek(0)
            print(f"--- {name}, {ended=}", output.read().decode()[-3000:], sep="\n")  # noqa: T201 - for a failed test
