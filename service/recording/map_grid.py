"""The map of a call as a Foxglove grid."""

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Vector2_pb2 import Vector2
from google.protobuf.timestamp_pb2 import Timestamp

from model.scenes.raster import reduced
from model.scenes.scene import Raster
from service.recording.frames import GROUND, pose

_MAX_CELLS = 2**20
"""Max number of cells; of a larger raster several pixels share one."""
_BELOW = -0.05
"""m; keeps the map below what is drawn on it."""
_CHANNELS = ("red", "green", "blue", "alpha")
_COLORS = np.array([(74, 80, 90, 255), (217, 154, 28, 255), (235, 235, 235, 255)], dtype=np.uint8)
"""RGBA of driveable area, road dividers and lane dividers; each covers those before it."""


def map_grid(raster: Raster, time: Timestamp) -> Grid:
    """Return the layers of a raster as a grid of colours; what no layer covers is transparent."""
    layers, step = reduced(raster.layers, _MAX_CELLS)
    _, rows, columns = layers.shape
    colors = np.zeros((columns, rows, len(_CHANNELS)), dtype=np.uint8)  # rows of a grid run along x
    for layer, color in zip(layers, _COLORS, strict=True):
        colors[layer.T > 0] = color
    cell = step / raster.pixels_per_meter
    # A grid is placed by the corner of its first cell, a raster by the middle of its first pixel
    x, y = (raster.origin - 0.5 / raster.pixels_per_meter).tolist()
    return Grid(
        timestamp=time,
        frame_id=GROUND,
        pose=pose(x, y, _BELOW),
        column_count=rows,
        cell_size=Vector2(x=cell, y=cell),
        row_stride=rows * len(_CHANNELS),
        cell_stride=len(_CHANNELS),
        fields=[
            PackedElementField(name=name, offset=offset, type=PackedElementField.UINT8)
            for offset, name in enumerate(_CHANNELS)
        ],
        data=colors.tobytes(),
    )
