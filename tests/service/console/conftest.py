"""A browser for the tests of a module."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser

from tests.service.console.browser import MISSING, chromium, launched


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Return the system's Chromium; skip where it is missing."""
    path = chromium()
    if path is None:
        pytest.skip(MISSING)
    with launched(path) as running:
        yield running
