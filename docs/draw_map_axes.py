"""The picture of a raster's axes and layers: ``python -m docs.draw_map_axes`` writes images/map_axes.png."""

import io

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from PIL import Image

from cab_forecast.layers import LAYER_NAMES, Layers, decode_layers
from cab_forecast.maps import read_map
from cab_forecast.plot import DRIVEABLE, INK, LANE_DIVIDER, ROAD_DIVIDER
from docs.generate import DOCS

PICTURE = DOCS / "images/map_axes.png"
_SIZE = 44.0
"""Side of the drawn cut, m."""
_COLORS = 64
_CAR = np.array([(2.3, 0.0), (1.6, 1.0), (-2.3, 1.0), (-2.3, -1.0), (1.6, -1.0)])
"""Outline of a vehicle in its own frame, m."""


def main() -> None:
    """Draw the junction of the examples as an array of three layers, and in the ground frame."""
    raster = read_map(DOCS / "data/junction.geojson").cut((4.0, 6.0), _SIZE)
    layers = decode_layers(raster.image, raster.rows, raster.columns)
    figure = Figure(figsize=(9.2, 4.4), layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    array, ground = figure.subplots(1, 2, width_ratios=(1.08, 1))
    _array(array, layers)
    _ground(ground, layers, (raster.origin_x, raster.origin_y))
    file = io.BytesIO()
    canvas.print_figure(file, dpi=110)
    # Few colors, and no date or version inside
    Image.open(file).convert("RGB").quantize(_COLORS, dither=Image.Dither.NONE).save(PICTURE, optimize=True)


def _array(axes: Axes, layers: Layers) -> None:
    """Draw the layers behind one another, as images are usually shown: rows downwards."""
    _, rows, columns = layers.shape
    colors = ((DRIVEABLE, "#8a93a0"), (ROAD_DIVIDER, ROAD_DIVIDER), (LANE_DIVIDER, "#8a93a0"))
    for number in (2, 1, 0):
        shift = 26 * number
        extent = (shift, shift + columns, rows - shift, -shift)
        shown = np.full((rows, columns, 3), 0.97)
        shown[layers[number]] = [int(colors[number][1][at : at + 2], 16) / 255 for at in (1, 3, 5)]
        axes.imshow(shown, extent=extent, interpolation="nearest", zorder=-number)
        axes.plot(
            *np.array([(shift, -shift), (shift + columns, -shift), (shift + columns, rows - shift)]).T,
            color=INK,
            linewidth=0.8,
            zorder=-number + 0.1,
        )
        axes.text(
            shift + columns + 3,
            rows - shift - 3,
            f"layer {number}: {LAYER_NAMES[number]}",
            fontsize=8,
            color=INK,
        )
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.4}
    axes.annotate("", (-8, 60), (-8, 0), arrowprops=arrow, annotation_clip=False)
    axes.annotate("", (60, rows + 8), (0, rows + 8), arrowprops=arrow, annotation_clip=False)
    axes.text(-14, 30, "row i: along x", rotation=90, ha="right", va="center", fontsize=8.5, color=INK)
    axes.text(30, rows + 14, "column j: along y", ha="center", va="top", fontsize=8.5, color=INK)
    axes.plot(0, 0, "o", color="#c8374a", markersize=6, clip_on=False)
    axes.text(3, 10, "[0, 0, 0]", fontsize=8, color="#c8374a")
    axes.set_xlim(-30, columns + 125)
    axes.set_ylim(rows + 30, -60)
    axes.axis("off")
    axes.set_title("the array: layers[3, rows, columns]", fontsize=9.5, color=INK)


def _ground(axes: Axes, layers: Layers, origin: tuple[float, float]) -> None:
    """Draw the ground frame: x to the right, y up, headings counter-clockwise from x."""
    image = np.full((*layers.shape[1:], 3), 0.97)
    for layer, color in zip(layers, (DRIVEABLE, ROAD_DIVIDER, LANE_DIVIDER), strict=True):
        image[layer] = [int(color[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    (x, y), half = origin, 1 / 6
    extent = (x - half, x + _SIZE + half, y - half, y + _SIZE + half)
    axes.imshow(image.swapaxes(0, 1), origin="lower", extent=extent, interpolation="nearest")
    angle = np.pi / 2
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    axes.add_patch(Polygon(_CAR @ turn + np.array([1.75, 16.0]), facecolor="#1f5fae", edgecolor="white"))
    axes.text(4.2, 16, "heading π/2", fontsize=8, color="#1f5fae", va="center")
    axes.add_patch(Polygon(_CAR + np.array([-8.0, -1.75]), facecolor="#1f5fae", edgecolor="white"))
    axes.text(-8, -4.6, "heading 0", fontsize=8, color="#1f5fae", ha="center", va="center")
    axes.plot(x, y, "o", color="#c8374a", markersize=6, clip_on=False, zorder=9)
    axes.text(x + 1, y + 1, "origin_x, origin_y: shown by [·, 0, 0]", fontsize=8, color="#c8374a")
    axes.set_xlabel("x, m", fontsize=8.5, color=INK)
    axes.set_ylabel("y, m", fontsize=8.5, color=INK)
    axes.tick_params(labelsize=8, colors=INK)
    axes.set_title("the ground frame", fontsize=9.5, color=INK)


if __name__ == "__main__":
    main()
