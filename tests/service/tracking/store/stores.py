"""Stores to test, on real servers."""

import shutil
import uuid
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from service.redis_url import parse_address
from service.tracking.store.base import TrackStore
from service.tracking.store.memory import MemoryStore
from service.tracking.store.redis.connection import connect
from service.tracking.store.redis.store import RedisStore

EXPIRY = 30.0
MAX_AGENTS = 10_000


def require_redis() -> None:
    """Skip the test if Redis is not installed."""
    if shutil.which("redis-server") is None:
        pytest.skip("redis-server is not installed")


@asynccontextmanager
async def opened(
    url: str, expiry: float = EXPIRY, max_agents: int = MAX_AGENTS, timeout_s: float = 5.0
) -> AsyncIterator[RedisStore]:
    """Open a store on Redis."""
    address = parse_address(url)
    store = RedisStore(
        connect(address, timeout_s=timeout_s, connections=8),
        connect(address, timeout_s=10.0, connections=8),
        expiry,
        max_agents,
    )
    try:
        yield store
    finally:
        await store.close()


def memory() -> TrackStore:
    """Return an in-process store."""
    return MemoryStore(EXPIRY, MAX_AGENTS)


def scene_name() -> str:
    """Return a scene id that no other test uses."""
    return f"scene {uuid.uuid4().hex}"
