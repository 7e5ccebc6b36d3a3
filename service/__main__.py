"""Entry point of ``python -m service``, the same as ``cab-forecast``."""

from cli.main import app

app()
