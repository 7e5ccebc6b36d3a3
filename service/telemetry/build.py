"""Build of the server: which version of the code runs, on what."""

import platform
from dataclasses import dataclass
from importlib import metadata


@dataclass(frozen=True)
class Build:
    """Versions of the code and of what the forward runs on."""

    version: str
    """Version of the package."""
    revision: str
    """Revision of the source; empty: not stated."""
    python: str
    torch: str
    onnxruntime: str


def build_of(revision: str) -> Build:
    """Return the build of this process.

    Args:
        revision: revision of the source; empty: unknown.
    """
    return Build(
        version=metadata.version("cab-forecast"),
        revision=revision,
        python=platform.python_version(),
        torch=metadata.version("torch"),
        onnxruntime=metadata.version("onnxruntime"),
    )
