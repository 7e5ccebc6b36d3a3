"""Fixtures of all tests."""

import os
from pathlib import Path

import pytest
import torch


def pytest_configure(config: pytest.Config) -> None:
    """Give each of several test processes one thread: more would wait for each other's cores.

    Servers have no worker processes, whose start takes seconds, unless the environment or a test says so.
    """
    os.environ.setdefault("FORECAST_WORKERS", "0")
    if hasattr(config, "workerinput"):
        torch.set_num_threads(1)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Return the folder with golden files and real nuScenes data, which lies beside the checkout."""
    here = Path(__file__).resolve().parents[1]
    folder = Path(os.environ.get("CAB_FORECAST_SHARED", here.parent / "shared"))
    if not folder.is_dir():
        pytest.skip(f"golden files and real data are not here: {folder}")
    return folder
