"""Checks of the rules by promtool, where it is installed."""

import shutil
import subprocess

import pytest

from tests.deploy.files import PROMETHEUS


@pytest.mark.parametrize(
    "words",
    [("check", "config", "--syntax-only", "prometheus.yml"), ("test", "rules", "alerts_test.yml")],
    ids=["configuration", "rules"],
)
def test_promtool_is_content(words: tuple[str, ...]) -> None:
    program = shutil.which("promtool")
    if program is None:
        pytest.skip("promtool, which comes with Prometheus, is not installed")
    done = subprocess.run(  # noqa: S603
        [program, *words], cwd=PROMETHEUS, capture_output=True, text=True, check=False, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
