"""Plot of a scene raster alone."""

from os import PathLike

import numpy as np
from matplotlib.patches import Patch

from cab.forecast.v1.prediction_service_pb2 import PredictRequest, SceneRaster
from cab_forecast.plot import (
    DOTS_PER_INCH,
    DRIVEABLE,
    INK,
    LANE_DIVIDER,
    ROAD_DIVIDER,
    canvas,
    draw_map,
)


def plot_map(raster: SceneRaster, path: str | PathLike[str], title: str = "") -> None:
    """Plot a scene raster in its ground frame: x to the right, y up.

    Args:
        raster: a raster with an image.
        path: file to write; its suffix determines the format (png, svg, pdf, …).
        title: text above the picture.

    Raises:
        ValueError: the raster contradicts itself, or matplotlib does not know the format.
        OSError: the file cannot be written.
    """
    size = np.array([raster.rows, raster.columns]) / raster.pixels_per_meter
    figure, axes = canvas(size)
    draw_map(axes, PredictRequest(scene_raster=raster))
    layers = {"driveable area": DRIVEABLE, "road dividers": ROAD_DIVIDER, "lane dividers": LANE_DIVIDER}
    figure.legend(
        handles=[Patch(facecolor=color, edgecolor=INK, label=name) for name, color in layers.items()],
        loc="outside lower center",
        ncols=len(layers),
        fontsize=8,
        frameon=False,
        labelcolor=INK,
    )
    axes.set_title(title, loc="left", fontsize=11, color=INK)
    figure.savefig(path, dpi=DOTS_PER_INCH)
