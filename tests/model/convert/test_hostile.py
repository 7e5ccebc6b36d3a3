"""Files made to hurt the process that reads them, read in a process of their own."""

import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.model.convert.hostile import HOSTILE, Outcome, write

MAX_SECONDS = 10
"""Far more than any takes; without limits they would take minutes, or have no end."""
MAX_MEGABYTES = 256


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Outcome]:
    """Return the outcomes of all files by name, up to the one at which the process ended."""
    folder = tmp_path_factory.mktemp("hostile")
    write(folder)
    run = subprocess.run(  # noqa: S603 - ourselves
        [sys.executable, "-m", "tests.model.convert.hostile", str(folder)],
        cwd=Path(__file__).parents[3],
        stdout=subprocess.PIPE,
        text=True,
        timeout=300,
        check=False,
    )
    return {(outcome := Outcome(*json.loads(line))).name: outcome for line in run.stdout.splitlines()}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_within_bounds(outcomes: Mapping[str, Outcome], name: str) -> None:
    assert name in outcomes, "the process that read it has died"
    outcome = outcomes[name]
    assert outcome.error in {"ConversionError", "UnsafePickleError"}
    assert HOSTILE[name].told in outcome.message
    assert len(outcome.message) < 1000
    assert outcome.seconds < MAX_SECONDS
    assert outcome.megabytes < MAX_MEGABYTES
