"""Scene rasters that the server has: the client names them by their digest."""

import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import Generic, TypeVar

from cab.forecast.v1.digest import raster_digest
from cab.forecast.v1.explanation_service_pb2 import ExplainRequest
from cab.forecast.v1.prediction_service_pb2 import PredictRequest, SceneRaster

__all__ = ["MIN_IMAGE_BYTES", "RasterDigests", "SceneRequest", "Sending", "raster_digest"]

SceneRequest = TypeVar("SceneRequest", PredictRequest, ExplainRequest)
"""Requests with a scene raster."""

MIN_IMAGE_BYTES = 4096
"""Encoded size from which rasters are named by their digest; smaller ones are always sent whole."""
_MAX_SEEN = 1024
"""Rasters that are remembered, by their digests."""
_MAX_UNREPEATED = 16
"""New rasters in a row, none of which was sent again, after which new ones are sent without a digest: a map
that is cut anew for each call would only fill the server's memory."""
_MAX_UNKNOWN = 7
"""Limit of the pauses: a raster that a server did not have n times in a row is sent whole in the next
2^(n − 1) − 1 calls."""


@dataclass
class _Seen:
    """A raster that was sent before."""

    kept: bool = False
    """True if a server has answered a call with the raster and its digest."""
    unknown: int = 0
    """Number of times in a row that a server did not have it."""
    pause: int = 0
    """Number of calls for which it is sent whole."""


@dataclass(frozen=True)
class Sending(Generic[SceneRequest]):
    """Decision on how the raster of a request is sent."""

    request: SceneRequest
    """The request to send."""
    digest: bytes = b""
    """Digest of its raster; empty: it is sent as it was given."""
    named: bool = False
    """True if the request names the raster by its digest alone."""


class RasterDigests:
    """Digests of the rasters that were sent, usable from several threads."""

    def __init__(self) -> None:
        self._seen: OrderedDict[bytes, _Seen] = OrderedDict()
        """Least recently used first."""
        self._unrepeated = 0
        """New rasters since one was sent again."""
        self._lock = threading.Lock()

    def prepare(self, request: SceneRequest) -> Sending[SceneRequest]:
        """Return how to send a request: with the digest of its raster alone if a server should have it."""
        raster = request.scene_raster
        if not request.HasField("scene_raster") or _image_bytes(raster) < MIN_IMAGE_BYTES:
            return Sending(request)
        digest = raster.digest or raster_digest(raster)
        with self._lock:
            seen = self._seen.get(digest)
            if seen is None:
                self._add(digest)
                if self._unrepeated > _MAX_UNREPEATED:
                    return Sending(request)
                named = False
            else:
                self._seen.move_to_end(digest)
                self._unrepeated = 0
                named = seen.kept and not seen.pause
                seen.pause = max(seen.pause - 1, 0)
        return Sending(_with_raster(request, digest, whole=not named), digest, named)

    def whole(self, request: SceneRequest, sent: Sending[SceneRequest]) -> Sending[SceneRequest]:
        """Return how to send a request again whose raster the server did not have."""
        with self._lock:
            seen = self._seen.setdefault(sent.digest, _Seen())
            seen.unknown = min(seen.unknown + 1, _MAX_UNKNOWN)
            # Once is usual: the server dropped it, or another replica answered
            seen.pause = 2 ** (seen.unknown - 1) - 1
        return Sending(_with_raster(request, sent.digest, whole=True), sent.digest)

    def answered(self, sent: Sending[SceneRequest]) -> None:
        """Note that a server has answered, and so has the raster."""
        if sent.digest:
            with self._lock:
                seen = self._seen.setdefault(sent.digest, _Seen())
                seen.kept = True
                if sent.named:
                    seen.unknown = 0

    def _add(self, digest: bytes) -> None:
        self._seen[digest] = _Seen()
        self._unrepeated += 1
        if len(self._seen) > _MAX_SEEN:
            self._seen.popitem(last=False)


def _image_bytes(raster: SceneRaster) -> int:
    return len(raster.image.packed_bits) + len(raster.image.png)


def _with_raster(request: SceneRequest, digest: bytes, whole: bool) -> SceneRequest:
    """Return a copy of a request, with the raster and its digest, or with the digest alone."""
    copy = type(request)()
    for field, value in request.ListFields():
        if field.name == "scene_raster":
            continue
        if field.is_repeated:
            getattr(copy, field.name).extend(value)
        elif field.message_type is not None:
            getattr(copy, field.name).CopyFrom(value)
        else:
            setattr(copy, field.name, value)
    if whole:
        copy.scene_raster.CopyFrom(request.scene_raster)
    copy.scene_raster.digest = digest
    return copy
