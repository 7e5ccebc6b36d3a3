"""The map of a scene as a picture for watchers."""

import io
import itertools

import numpy as np
from PIL import Image

from cab.forecast.v1 import scene_service_pb2 as pb
from model.arrays import Bytes
from model.scenes.raster import reduced
from model.scenes.scene import Raster

MAX_PIXELS = 2**20
"""Max number of pixels of the picture; of a larger raster several share one."""
_PALETTE = [
    255 * bit for bits in itertools.product((0, 1), repeat=3) for bit in reversed(bits)
]  # index 1 is red, 2 green, 4 blue
_BITS: Bytes = np.array([1, 2, 4], dtype=np.uint8)


def scene_map(raster: Raster, digest: bytes) -> pb.SceneMap:
    """Return the map that shows a raster. Takes milliseconds.

    Args:
        raster: the raster.
        digest: its digest.
    """
    layers, step = reduced(raster.layers, MAX_PIXELS)
    index: Bytes = (layers * _BITS[:, None, None]).sum(axis=0, dtype=np.uint8)
    picture = Image.fromarray(index)
    picture.putpalette(_PALETTE)
    encoded = io.BytesIO()
    picture.save(encoded, format="PNG")
    # A coarser pixel shows the middle of those that it stands for
    x, y = (raster.origin + 0.5 * (step - 1) / raster.pixels_per_meter).tolist()
    rows, columns = index.shape
    return pb.SceneMap(
        digest=digest,
        origin_x=x,
        origin_y=y,
        pixels_per_meter=raster.pixels_per_meter / step,
        width=columns,
        height=rows,
        image=encoded.getvalue(),
    )
