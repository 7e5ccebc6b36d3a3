"""Secrets that a log must not contain."""

import logging
from collections.abc import Iterator

import pytest
import structlog

from service.telemetry import logs


@pytest.fixture
def restored() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers, root.level
    yield
    root.handlers = handlers
    root.setLevel(level)
    structlog.reset_defaults()


@pytest.mark.parametrize("as_json", [True, False])
@pytest.mark.usefixtures("restored")
def test_tracebacks_show_no_values(as_json: bool, capsys: pytest.CaptureFixture[str]) -> None:
    logs.configure("info", as_json)

    def connect(password: str) -> None:
        raise ConnectionError(f"refused after {len(password)} characters")

    try:
        connect("".join(["hunter", "2"]))
    except ConnectionError:
        structlog.get_logger("test").exception("failed")
    text = capsys.readouterr().err
    assert "refused after 7 characters" in text
    assert "connect" in text
    assert "hunter2" not in text
