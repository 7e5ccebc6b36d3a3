"""The program as a whole."""

import re
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from cli.main import app
from service.settings import Settings


def test_version() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert result.exit_code == 0
    assert result.stdout.startswith("cab-forecast 0.")


def test_help_names_the_commands_and_loads_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from cli.main import app\n"
        "try: app(['--help'])\n"
        "except SystemExit: pass\n"
        "print('LOADED', *{m.partition('.')[0] for m in sys.modules})"
    )
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)  # noqa: S603
    text, _, loaded = run.stdout.partition("LOADED")
    for command in (
        "serve",
        "doctor",
        "predict",
        "map",
        "reload",
        "replay",
        "consistency",
        "convert",
        "train",
        "evaluate",
        "benchmark",
    ):
        assert command in text
    assert not {"torch", "numpy", "matplotlib", "grpc", "httpx", "fastapi", "model"} & set(loaded.split())


def test_help_of_serve_lists_all_settings_and_loads_no_model() -> None:
    code = (
        "import sys\n"
        "from cli.main import app\n"
        "try: app(['serve', '--help'])\n"
        "except SystemExit: pass\n"
        "print('LOADED', *{m.partition('.')[0] for m in sys.modules})"
    )
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)  # noqa: S603
    text, _, loaded = run.stdout.partition("LOADED")
    for name in Settings.model_fields:
        assert f"FORECAST_{name.upper()}" in text
    assert re.search(r"FORECAST_MAX_AGENTS +512 +Max number of agents", text)
    assert not {"torch", "grpc", "fastapi", "model"} & set(loaded.split())


@pytest.mark.parametrize("package", ["cli", "service"])
def test_it_runs_as_a_module(package: str) -> None:
    command = [sys.executable, "-m", package, "--version"]
    run = subprocess.run(command, check=True, capture_output=True, text=True)  # noqa: S603
    assert run.stdout.startswith("cab-forecast 0.")
