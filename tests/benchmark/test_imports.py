"""The benchmark is a client: what forecasts is behind the endpoint."""

import subprocess
import sys

MODULES = ("run", "evaluate", "in_process", "submission", "tables", "compare", "report.page")
FORBIDDEN = (
    "model.networks",
    "model.networks.forecaster",
    "model.networks.forecaster",
    "model.registry",
    "model.checkpoint",
    "service",
)


def test_neither_networks_nor_the_server_are_loaded() -> None:
    code = f"import sys\n{'; '.join(f'import benchmark.{name}' for name in MODULES)}\nprint(*sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    loaded = shown.stdout.split()
    assert "benchmark.replay" in loaded
    assert not [name for name in loaded if name.startswith(FORBIDDEN)]
