"""Checks of recorded pairs and rasters before they are trained on."""

from collections.abc import Sequence

import numpy as np

from model.data.scenes import DataError, Pair, Track
from model.scenes.raster import PATCH_PIXELS_PER_METER
from model.scenes.scene import AgentType, Raster

FUTURE_STEPS = 12
"""Frames of truth after the present: 6 s."""
STEPS_AHEAD = np.arange(1, FUTURE_STEPS + 1)
"""[12], numbers of these frames, counted from the present."""


def check_pairs(where: str, tracks: Sequence[Track], pairs: Sequence[Pair]) -> None:
    """Refuse pairs that are no vehicles, or lack a frame before the present or some of the 12 after it.

    Args:
        where: name of the file (or scene), for the error.
        tracks: tracks of the scene.
        pairs: pairs of the scene.

    Raises:
        DataError: a pair cannot be trained on; names it.
    """
    for pair in pairs:
        track = tracks[pair.track]
        name = f"{where}: agent {track.id} at frame {pair.frame}"
        if track.type is not AgentType.VEHICLE:
            raise DataError(f"{name} is a pair but is a {track.type.value}, not a vehicle")
        now = int(np.searchsorted(track.frames, pair.frame))
        if now == len(track.frames) or track.frames[now] != pair.frame:
            raise DataError(f"{name} is a pair but not annotated then")
        if now == 0 or pair.frame - track.frames[now - 1] > 2:
            raise DataError(f"{name} is a pair but has no history")
        future = track.frames[now + 1 : now + 1 + FUTURE_STEPS]
        if len(future) < FUTURE_STEPS or future[-1] != pair.frame + FUTURE_STEPS:
            raise DataError(f"{name} is a pair but has no whole future of {FUTURE_STEPS} frames")


def check_raster(where: str, raster: Raster) -> None:
    """Refuse a raster that ``model.scenes.raster`` would have to coarsen before it cuts patches.

    Args:
        where: name of the file (or scene), for the error.
        raster: raster of the scene.

    Raises:
        DataError: the raster has twice the patches' resolution or more.
    """
    if raster.pixels_per_meter >= 2 * PATCH_PIXELS_PER_METER:
        raise DataError(
            f"{where}: a raster of {raster.pixels_per_meter:g} pixels per metre is too fine;"
            f" it has to have less than {2 * PATCH_PIXELS_PER_METER:g}"
        )
