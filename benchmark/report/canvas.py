"""Basics of the report's figures: empty figures, a style for each model, bytes to embed."""

import io
from collections.abc import Iterable
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from cab_forecast.plot import INK

DOTS_PER_INCH = 110
_PADDING = 0.1
"""Margin in inches; titles of two lines would be cut with less."""
_MIN_WIDTH = 8.0
"""Minimum width in inches, so that a legend fits."""
FRAME = "#b8bec4"
GRID = "#e4e7ea"
REFERENCE = "#6b7480"
"""Colour of reference values."""

# Safe for colour blindness (Okabe and Ito); brown and violet replace their orange and black, which maps use
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#7f3b08", "#56b4e9", "#6a3d9a")
_LINES = ("-", (0, (6, 1.5, 1, 1.5)), (0, (1, 1.2)))
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*", "d")


@dataclass(frozen=True)
class Style:
    """Line and marker of a model."""

    color: str
    line: str | tuple[int, tuple[float, ...]]
    marker: str


def styles(models: Iterable[str]) -> dict[str, Style]:
    """Return a style for each model, in order; models of equal colour differ in line and marker."""
    return {
        model: Style(
            _COLORS[place % len(_COLORS)],
            _LINES[place // len(_COLORS) % len(_LINES)],
            _MARKERS[place % len(_MARKERS)],
        )
        for place, model in enumerate(models)
    }


def plain(text: str) -> str:
    """Escape a text so that matplotlib reads no formula in it."""
    return text.replace("$", r"\$")


def empty(width: float, height: float) -> Figure:
    """Return a figure of a size in inches, without pyplot and its global state."""
    layout = ConstrainedLayoutEngine(h_pad=_PADDING, w_pad=_PADDING)
    return Figure(figsize=(width, height), layout=layout, facecolor="white")


def grid(panels: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure with equal panels in rows.

    Args:
        panels: number of panels.
        columns: maximum number of panels in a row.
        width: width of a panel, inches.
        height: height of a panel, inches.
    """
    columns = min(columns, panels)
    rows = -(-panels // columns)
    figure = empty(max(width * columns, _MIN_WIDTH), height * rows + 0.4)
    return figure, [figure.add_subplot(rows, columns, place + 1) for place in range(panels)]


def dress(axes: Axes) -> None:
    """Draw frame and grid in muted colours."""
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=9, length=3)
    for side, spine in axes.spines.items():
        spine.set_visible(side in {"left", "bottom"})
        spine.set_color(FRAME)


def svg(figure: Figure) -> bytes:
    """Return the figure as SVG; equal figures give equal bytes."""
    file = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "cab-forecast"}):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


def png(figure: Figure) -> bytes:
    """Return the figure as PNG."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()
