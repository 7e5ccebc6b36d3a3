"""Decoded rasters by digest, within a budget of bytes."""

from collections import OrderedDict
from dataclasses import dataclass

from model.scenes.scene import Raster


@dataclass
class KeptRaster:
    """A decoded raster."""

    raster: Raster
    """The raster, whose layers nobody may write to."""
    touch_at: float
    """Time from which on the next use is reported to Redis, s."""

    @property
    def size(self) -> int:
        """Bytes of the layers."""
        return self.raster.layers.nbytes


class RasterCache:
    """Decoded rasters; beyond the budget the least recently used are dropped. Used in one thread.

    Args:
        max_bytes: size of all rasters, at most.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._rasters: OrderedDict[bytes, KeptRaster] = OrderedDict()
        """Rasters by digest, least recently used first."""
        self.size = 0
        """Bytes of all rasters."""

    def __len__(self) -> int:
        return len(self._rasters)

    def get(self, digest: bytes) -> KeptRaster | None:
        """Return a raster, and count this as a use; None: it is not kept."""
        kept = self._rasters.get(digest)
        if kept is not None:
            self._rasters.move_to_end(digest)
        return kept

    def put(self, digest: bytes, kept: KeptRaster) -> int:
        """Keep a raster, unless it alone exceeds the budget.

        Returns:
            The number of rasters that were dropped for it.
        """
        if kept.size > self._max_bytes or digest in self._rasters:
            return 0
        self._rasters[digest] = kept
        self.size += kept.size
        dropped = 0
        while self.size > self._max_bytes:
            _, oldest = self._rasters.popitem(last=False)
            self.size -= oldest.size
            dropped += 1
        return dropped
