"""The request's map in the ground frame."""

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.transforms import Affine2D

from cab.forecast.v1.bounds import PATCH_PIXELS
from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest
from cab_forecast.layers import Layers, decode_layers
from cab_forecast.plot_style import DRIVEABLE, LANE_DIVIDER, ROAD_DIVIDER
from cab_forecast.requests import PIXELS_PER_METER

_PATCH_ORIGIN = (-10 / PIXELS_PER_METER, -50 / PIXELS_PER_METER)
"""Where a patch's first pixel is, m ahead of and to the left of the agent."""


def draw_map(axes: Axes, request: PredictRequest) -> None:
    """Draws the scene's raster, and the patches of agents that bring their own and a heading.

    Raises:
        ValueError: a map whose bytes do not fit its size.
    """
    if request.HasField("scene_raster"):
        raster = request.scene_raster
        layers = decode_layers(raster.image, raster.rows, raster.columns)
        _draw(axes, layers, (raster.origin_x, raster.origin_y), raster.pixels_per_meter, Affine2D())
    for agent in request.agents:
        if agent.HasField("map_patch") and agent.states and agent.states[-1].HasField("heading"):
            layers = decode_layers(agent.map_patch.image, PATCH_PIXELS, PATCH_PIXELS)
            _draw(axes, layers, _PATCH_ORIGIN, PIXELS_PER_METER, _to_ground(agent))


def _draw(
    axes: Axes, layers: Layers, origin: tuple[float, float], pixels_per_meter: float, transform: Affine2D
) -> None:
    # A pixel's value belongs to its middle: the picture reaches half a pixel beyond the outer ones.
    (x, y), (rows, columns) = origin, layers.shape[1:]
    half = 0.5 / pixels_per_meter
    extent = (x - half, x + rows / pixels_per_meter - half, y - half, y + columns / pixels_per_meter - half)
    axes.imshow(
        _colors(layers).swapaxes(0, 1),  # rows run along x, an image's along y
        origin="lower",
        extent=extent,
        transform=transform + axes.transData,
        interpolation="antialiased",
        zorder=0,
    )


def _colors(layers: Layers) -> npt.NDArray[np.float64]:
    """RGBA of [3, rows, columns] layers, see-through where none is set: [rows, columns, 4]."""
    image = np.zeros((*layers.shape[1:], 4))
    image[:, :, :3] = to_rgba(DRIVEABLE)[:3]  # or the edges would blend with black
    for layer, color in zip(layers, (DRIVEABLE, ROAD_DIVIDER, LANE_DIVIDER), strict=True):
        image[layer] = to_rgba(color)
    return image


def _to_ground(agent: Agent) -> Affine2D:
    now = agent.states[-1]
    return Affine2D().rotate(now.heading).translate(now.x, now.y)
