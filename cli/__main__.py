"""Entry point of ``python -m cli``, the same as ``cab-forecast``."""

from cli.main import app

app(prog_name="cab-forecast")
