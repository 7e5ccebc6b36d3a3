"""Factory of the store that the settings name."""

from service.redis_url import parse_address
from service.settings import Settings
from service.tracking.store.base import TrackStore
from service.tracking.store.memory import MemoryStore

_WATCH_TIMEOUT = 10.0
"""Seconds; a watcher's reads block in Redis for 2 s at most."""


def make_store(settings: Settings) -> TrackStore:
    """Return the store; it connects at its first call."""
    if settings.store == "memory":
        return MemoryStore(settings.track_expiry, settings.max_tracked_agents)
    # Imported only where it is used
    from service.tracking.store.redis.connection import connect  # noqa: PLC0415
    from service.tracking.store.redis.store import RedisStore  # noqa: PLC0415

    address = parse_address(settings.store)
    client = connect(
        address, timeout_s=settings.store_timeout_ms / 1000, connections=settings.store_connections
    )
    watch_client = connect(address, timeout_s=_WATCH_TIMEOUT, connections=settings.max_watchers)
    return RedisStore(client, watch_client, settings.track_expiry, settings.max_tracked_agents)
