"""The track memory that the settings ask for."""

from service.redis_url import parse_address
from service.settings import Settings
from service.tracking.store.base import TrackStore
from service.tracking.store.memory import MemoryStore

MAX_WATCHERS = 64
"""Of one server; with Redis each has a connection of its own."""
_WATCH_TIMEOUT = 10.0
"""s; a watcher's reads wait in Redis for events, 2 s at most."""


def make_store(settings: Settings) -> TrackStore:
    """The store; nothing is connected yet."""
    if settings.store == "memory":
        return MemoryStore(settings.track_expiry, settings.max_tracked_agents)
    # Not loaded where it is not used
    from service.tracking.store.redis.connection import connect  # noqa: PLC0415
    from service.tracking.store.redis.store import RedisStore  # noqa: PLC0415

    address = parse_address(settings.store)
    client = connect(
        address, timeout_s=settings.store_timeout_ms / 1000, connections=settings.store_connections
    )
    watching = connect(address, timeout_s=_WATCH_TIMEOUT, connections=MAX_WATCHERS)
    return RedisStore(client, watching, settings.track_expiry, settings.max_tracked_agents)
