"""Small maps in each format, and maps of others where they are at hand."""

import os
from pathlib import Path

import pytest

FOREIGN = "CAB_FORECAST_FOREIGN_MAPS"
"""Environment variable with the folder of the maps that ``docs/maps.md`` lists under "foreign maps"."""


def foreign(name: str) -> Path:
    """Return the path of a map that was not made for these tests, or skip the test."""
    folder = os.environ.get(FOREIGN)
    if folder is None or not (Path(folder) / name).is_file():
        pytest.skip(f"{name} is not here: docs/maps.md says where it is from; {FOREIGN} names its folder")
    return Path(folder) / name
