"""What has to hold of recorded pairs before they are trained on."""

from collections.abc import Sequence

import numpy as np

from model.data.scenes import DataError, Pair, Track
from model.scenes.raster import PATCH_PIXELS_PER_METER
from model.scenes.scene import AgentType, Raster

FUTURE_STEPS = 12
"""Frames of truth behind the present: 6 s."""
STEPS_AHEAD = np.arange(1, FUTURE_STEPS + 1)
"""[12], these frames, counted from the present."""


def check_pairs(where: str, tracks: Sequence[Track], pairs: Sequence[Pair]) -> None:
    """Every pair is a vehicle with a frame before the present and all ``FUTURE_STEPS`` after it.

    Args:
        where: the file (or scene) to name.
        tracks: of the scene.
        pairs: of the scene.

    Raises:
        DataError: a pair is not so.
    """
    for pair in pairs:
        track = tracks[pair.track]
        name = f"{where}: agent {track.id} at frame {pair.frame}"
        if track.type is not AgentType.VEHICLE:
            raise DataError(f"{name} is asked for but is a {track.type.value}, not a vehicle")
        now = int(np.searchsorted(track.frames, pair.frame))
        if now == len(track.frames) or track.frames[now] != pair.frame:
            raise DataError(f"{name} is asked for but not annotated then")
        if now == 0 or pair.frame - track.frames[now - 1] > 2:
            raise DataError(f"{name} is asked for but has no history")
        future = track.frames[now + 1 : now + 1 + FUTURE_STEPS]
        if len(future) < FUTURE_STEPS or future[-1] != pair.frame + FUTURE_STEPS:
            raise DataError(f"{name} is asked for but has no whole future of {FUTURE_STEPS} frames")


def check_raster(where: str, raster: Raster) -> None:
    """The raster is one that patches are cut from as it is: ``model.scenes.raster`` first coarsens finer
    ones.

    Args:
        where: the file (or scene) to name.
        raster: of the scene.

    Raises:
        DataError: it has twice the patches' resolution or more.
    """
    if raster.pixels_per_meter >= 2 * PATCH_PIXELS_PER_METER:
        raise DataError(
            f"{where}: a raster of {raster.pixels_per_meter:g} pixels per metre is too fine:"
            f" it has to have less than {2 * PATCH_PIXELS_PER_METER:g}"
        )
