"""``python -m service``: the same as ``cab-forecast``."""

from service.cli.main import app

app()
