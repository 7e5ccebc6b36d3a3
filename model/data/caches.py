"""A folder of caches that runs share: a cache is made when it is first asked for."""

import hashlib
from collections.abc import Callable
from pathlib import Path

from model.data.cache import Cache, build_cache
from model.data.cache_layout import CacheKey
from model.data.scenes import DataError, Reader
from model.forecaster import Protocol
from model.networks.config import AnyNetworkConfig


def open_cache(
    folder: Path,
    reader: Reader,
    kind: str,
    split: str,
    protocol: Protocol,
    config: AnyNetworkConfig,
    history_frames: int,
    said: Callable[[str], None],
    variants: int = 0,
) -> Cache:
    """The cache of a split, made first where it is not there or stale.

    Args:
        folder: of the caches.
        reader: of the data.
        kind: of the data, for the cache's name.
        split: one of the reader's.
        protocol: of the inputs.
        config: says which neighbours are looked at, and how.
        history_frames: F, frames of history, now included.
        said: told in words that a cache is made, and why.
        variants: V, noisy reports of each pair (agent frame only).

    Raises:
        DataError: the data is bad, or there are no pairs.
    """
    key = CacheKey.of(reader, split, protocol, config, history_frames, variants)
    kinds = "".join(one.value[0] for one in key.neighbor_types) or "none"
    whose = hashlib.sha256(key.data.encode()).hexdigest()[:8]  # so that data sets do not replace each other's
    form = f"-agent{variants}" if key.agent_frame else "-drawn" * key.drawn
    place = folder / f"{kind}-{whose}-{split}-{protocol.value}-{history_frames}-{kinds}{form}"
    try:
        return Cache.open(place, key)
    except DataError as error:
        said(f"making the cache of {split}: {error}")
    build_cache(reader, split, protocol, config, history_frames, place, variants=variants)
    return Cache.open(place, key)
