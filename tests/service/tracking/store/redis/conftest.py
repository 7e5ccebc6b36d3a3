"""Redis for all tests of this folder."""

import pytest

from tests.service.tracking.store.stores import require_redis


@pytest.fixture(autouse=True)
def _redis() -> None:
    require_redis()
