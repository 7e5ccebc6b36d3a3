"""Rasters that calls name by their digest: found, verified, decoded once, and kept."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor
from time import monotonic
from typing import TypeVar

import structlog
from google.protobuf.message import DecodeError

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.digest import DIGEST_BYTES, raster_digest
from model.scenes.scene import Raster
from service.errors import BadField, UnknownRaster
from service.predict.rasters.cache import KeptRaster, RasterCache
from service.predict.rasters.shared import SharedRasters
from service.predict.request import decode_raster
from service.settings import Settings
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)

_T = TypeVar("_T")
_FIELD = "scene_raster.digest"
_TOUCHES = 3
"""Number of times that a raster in use is touched in Redis before it would expire there."""


class RasterLibrary:
    """Rasters by digest. Used on one event loop; hashing and decoding run in threads."""

    def __init__(
        self,
        settings: Settings,
        metrics: Metrics,
        threads: Executor,
        shared: SharedRasters | None = None,
        now: Callable[[], float] = monotonic,
    ) -> None:
        """
        Args:
            settings: the limits.
            metrics: receives lookups and sizes.
            threads: executor of the helper threads.
            shared: rasters in Redis; None: rasters are kept in this process only.
            now: clock, s.
        """
        self._settings = settings
        self._metrics = metrics
        self._threads = threads
        self._shared = shared
        self._now = now
        self._cache = RasterCache(settings.max_kept_raster_bytes)
        self._decoding: dict[bytes, asyncio.Task[Raster]] = {}
        """Rasters that are being decoded: calls with the same one wait for it."""

    async def find(self, message: pb.SceneRaster, time_left: float) -> Raster | None:
        """Return the raster that a message names by its digest; None if the message has no digest.

        All calls that name the same raster get the same object.

        Args:
            message: the raster of a request.
            time_left: seconds that the call can wait without missing its deadline.

        Raises:
            BadField: the digest is not that of the raster, or a field of the raster is invalid.
            UnknownRaster: the message has no image, and the raster is not kept.
        """
        digest = message.digest
        raster: Raster | None
        if not digest:
            return None
        if len(digest) != DIGEST_BYTES:
            raise BadField(_FIELD, f"must have {DIGEST_BYTES} bytes, has {len(digest)}")
        if message.HasField("image"):
            await self._verify(message)
            raster, source = await self._sent(digest, message)
        else:
            _check_alone(message)
            raster, source = await self._named(digest, time_left)
        self._metrics.raster_lookups.labels(source).inc()
        if raster is None:
            raise UnknownRaster(digest)
        return raster

    def keep(self, digest: bytes, message: pb.SceneRaster, raster: Raster) -> None:
        """Keep a raster that was sent without its digest, so that calls can name it.

        Args:
            digest: its digest.
            message: the raster as it was sent.
            raster: the decoded raster, whose layers nobody writes to any more.
        """
        if self._from_memory(digest) is not None:
            return
        raster.layers.flags.writeable = False
        self._put(digest, raster)
        if self._shared is not None:
            self._shared.put(digest, message.SerializeToString())

    async def close(self) -> None:
        """Wait for what is being decoded, and release the connections."""
        await asyncio.gather(*self._decoding.values(), return_exceptions=True)
        if self._shared is not None:
            await self._shared.close()

    async def _verify(self, message: pb.SceneRaster) -> None:
        """Refuse a digest that is not that of the image sent with it.

        Raises:
            BadField: the digests differ, or the image has no content.
        """
        if message.image.WhichOneof("encoding") is None:
            raise BadField("scene_raster.image", "give packed_bits or png")
        actual = await self._in_thread(raster_digest, message)
        if actual != message.digest:
            raise BadField(_FIELD, f"is not that of the raster, which is {actual.hex()}")

    async def _sent(self, digest: bytes, message: pb.SceneRaster) -> tuple[Raster, str]:
        """Return a raster that was sent whole, and the source "sent"."""
        raster = self._from_memory(digest)
        if raster is None:
            first = digest not in self._decoding
            raster = await self._decode(digest, message)
            if first and self._shared is not None:
                self._shared.put(digest, message.SerializeToString())
        return raster, "sent"

    async def _named(self, digest: bytes, time_left: float) -> tuple[Raster | None, str]:
        """Return a raster that was named by its digest alone, and its source; None: it is unknown."""
        raster = self._from_memory(digest)
        if raster is not None:
            return raster, "memory"
        if digest in self._decoding:
            return await asyncio.shield(self._decoding[digest]), "memory"
        if self._shared is not None:
            encoded = await self._shared.get(digest, time_left)
            message = None if encoded is None else await self._in_thread(_parse, encoded, digest)
            if message is not None:
                return await self._decode(digest, message), "redis"
        return None, "unknown"

    def _from_memory(self, digest: bytes) -> Raster | None:
        kept = self._cache.get(digest)
        if kept is None:
            return None
        if self._shared is not None and self._now() > kept.touch_at:
            kept.touch_at = self._next_touch()
            self._shared.touch(digest)
        return kept.raster

    async def _decode(self, digest: bytes, message: pb.SceneRaster) -> Raster:
        """Decode a raster and keep it; several calls with the same one share the work."""
        task = self._decoding.get(digest)
        if task is None:
            task = asyncio.create_task(self._decode_and_keep(digest, message), name="decode raster")
            self._decoding[digest] = task
            task.add_done_callback(lambda task: self._decoded(digest, task))
        return await asyncio.shield(task)  # other calls may wait for it when this one is cancelled

    async def _decode_and_keep(self, digest: bytes, message: pb.SceneRaster) -> Raster:
        raster = await self._in_thread(decode_raster, message, self._settings)
        raster.layers.flags.writeable = False
        self._put(digest, raster)
        return raster

    def _put(self, digest: bytes, raster: Raster) -> None:
        dropped = self._cache.put(digest, KeptRaster(raster, self._next_touch()))
        self._metrics.rasters_dropped.inc(dropped)
        self._metrics.raster_bytes.set(self._cache.size)

    def _decoded(self, digest: bytes, task: asyncio.Task[Raster]) -> None:
        del self._decoding[digest]
        if not task.cancelled():
            task.exception()  # retrieved, or asyncio would log that it never was

    def _next_touch(self) -> float:
        return self._now() + (self._shared.expiry / _TOUCHES if self._shared is not None else 0.0)

    async def _in_thread(self, function: Callable[..., _T], *arguments: object) -> _T:
        return await asyncio.get_running_loop().run_in_executor(self._threads, function, *arguments)


def _check_alone(message: pb.SceneRaster) -> None:
    """Refuse further fields beside a digest without an image.

    Raises:
        BadField: there is another field, which the digest covers already.
    """
    for field, _ in message.ListFields():
        if field.name != "digest":
            raise BadField(
                f"scene_raster.{field.name}", "must be left out where the digest stands without an image"
            )


def _parse(encoded: bytes, digest: bytes) -> pb.SceneRaster | None:
    """Return the raster that Redis holds; None if it is not that of the digest."""
    try:
        message = pb.SceneRaster.FromString(encoded)
        if raster_digest(message) == digest:
            return message
    except (DecodeError, ValueError):
        pass
    _log.warning("raster in Redis is damaged", digest=digest.hex())
    return None
