"""Encoded rasters in Redis, for all servers that use it, within a budget of bytes.

All rasters together are in one hash, in one slot of a cluster. They have keys and connections of their own,
and are given up when Redis' memory is nearly full, so that it need not evict tracks. A failure of Redis fails
no call: a raster is then unknown to the other servers.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any

from service.settings import Settings
from service.tracking.collector import StoreMetrics
from service.tracking.store.base import StoreError
from service.tracking.store.guard import Guard
from service.tracking.store.redis.scripts import Script

READ_BUDGET = 0.1
"""Seconds that a call waits for a raster; one of 2 MB takes a few milliseconds."""
_WRITE_BUDGET = 2.0
"""Seconds after which a raster that is being stored counts as failed; no call waits for it."""
_MAX_OUTSTANDING = 16
"""Number of operations in progress beyond which rasters are not stored."""
_CONNECTIONS = 4
_KEYS = tuple(f"cab:1:rasters:{{rasters}}:{name}" for name in ("images", "used", "bytes"))
_PACKAGE = "service.predict.rasters"


class SharedRasters:
    """Encoded rasters by digest. Used on one event loop.

    Args:
        client: client from ``service.tracking.store.redis.connection.connect``.
        expiry: seconds without a use after which a raster is dropped.
        max_bytes: size of all rasters, at most.
        metrics: receives durations and failures.
    """

    def __init__(self, client: Any, expiry: float, max_bytes: int, metrics: StoreMetrics) -> None:
        self.expiry = expiry
        """Seconds without a use after which a raster is dropped."""
        self._client = client
        self._max_bytes = max_bytes
        self._guard = Guard(
            metrics.observe, metrics.failed, calls="rasters", max_outstanding=2 * _MAX_OUTSTANDING
        )
        self._script = Script("use.lua", _PACKAGE)
        self._writing: set[asyncio.Task[None]] = set()

    @classmethod
    def from_settings(cls, settings: Settings, metrics: StoreMetrics) -> "SharedRasters | None":
        """Return the rasters in the store that the settings name; None if it is not Redis."""
        if settings.store == "memory" or not settings.max_stored_raster_bytes:
            return None
        # Imported only where it is used
        from service.redis_url import parse_address  # noqa: PLC0415
        from service.tracking.store.redis.connection import connect  # noqa: PLC0415

        client = connect(
            parse_address(settings.store),
            timeout_s=settings.store_timeout_ms / 1000,
            connections=_CONNECTIONS,
        )
        return cls(client, settings.track_expiry / 2, settings.max_stored_raster_bytes, metrics)

    async def get(self, digest: bytes, time_left: float) -> bytes | None:
        """Return an encoded raster; None if it is not there or Redis does not answer in time.

        Args:
            digest: the digest.
            time_left: seconds that the call can wait without missing its deadline.
        """
        try:
            found: bytes | None = await self._guard.run(
                "raster_get",
                lambda: self._use(digest, wanted=True),
                READ_BUDGET,
                time_left_s=max(time_left, 0.0),
            )
        except StoreError:  # the guard counts and logs it
            return None
        return found

    def put(self, digest: bytes, encoded: bytes) -> None:
        """Store a raster in the background."""
        self._write("raster_put", lambda: self._use(digest, encoded))

    def touch(self, digest: bytes) -> None:
        """Keep a raster from expiring, in the background."""
        self._write("raster_touch", lambda: self._use(digest))

    async def settle(self) -> None:
        """Wait until what was begun in the background has ended."""
        await asyncio.gather(*self._writing)

    async def close(self) -> None:
        """Cancel what is in progress and release the connections."""
        await self._guard.close()
        await self.settle()
        await self._client.aclose()

    async def _use(self, digest: bytes, encoded: bytes = b"", wanted: bool = False) -> Any:
        expiry_ms = round(self.expiry * 1000)
        arguments: list[str | bytes | int] = [digest, encoded, self._max_bytes, expiry_ms, int(wanted)]
        return await self._script.run(self._client, _KEYS, arguments)

    def _write(self, op: str, call: Callable[[], Awaitable[object]]) -> None:
        if self._guard.outstanding < _MAX_OUTSTANDING:
            task = asyncio.create_task(self._run(op, call), name=op)
            self._writing.add(task)
            task.add_done_callback(self._writing.discard)

    async def _run(self, op: str, call: Callable[[], Awaitable[object]]) -> None:
        with suppress(StoreError):  # the guard counts and logs it
            await self._guard.run(op, call, _WRITE_BUDGET)
