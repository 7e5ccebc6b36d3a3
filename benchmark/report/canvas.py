"""What all pictures of the report share: empty figures, a style for each model, bytes to embed."""

import io
from collections.abc import Iterable
from dataclasses import dataclass

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from cab_forecast.plot_style import INK

DOTS_PER_INCH = 110
_PADDING = 0.1
"""Inches around everything; titles of two lines would be cut with less."""
_LEAST_WIDTH = 8.0
"""Inches, for a legend to have room."""
FRAME = "#b8bec4"
GRID = "#e4e7ea"
REFERENCE = "#6b7480"
"""What something is held against: the paper's figures, what was said."""

# Told apart by those, too, who see fewer colours (Okabe and Ito); for their orange and black, which are on
# every map, brown and violet
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#7f3b08", "#56b4e9", "#6a3d9a")
_LINES = ("-", (0, (6, 1.5, 1, 1.5)), (0, (1, 1.2)))
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*", "d")


@dataclass(frozen=True)
class Style:
    """How a model is drawn."""

    color: str
    line: str | tuple[int, tuple[float, ...]]
    marker: str


def styles(models: Iterable[str]) -> dict[str, Style]:
    """A style for each model, by its place; where colours come again, lines and markers differ."""
    return {
        model: Style(
            _COLORS[place % len(_COLORS)],
            _LINES[place // len(_COLORS) % len(_LINES)],
            _MARKERS[place % len(_MARKERS)],
        )
        for place, model in enumerate(models)
    }


def plain(text: str) -> str:
    """A text of somebody's choice, which is no formula."""
    return text.replace("$", r"\$")


def empty(width: float, height: float) -> Figure:
    """A figure of so many inches that is nobody's but the caller's: no pyplot, no state."""
    layout = ConstrainedLayoutEngine(h_pad=_PADDING, w_pad=_PADDING)
    return Figure(figsize=(width, height), layout=layout, facecolor="white")


def grid(panels: int, columns: int, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Equal panels in rows.

    Args:
        panels: how many.
        columns: at most so many in a row.
        width: of a panel, inches.
        height: likewise.
    """
    columns = min(columns, panels)
    rows = -(-panels // columns)
    figure = empty(max(width * columns, _LEAST_WIDTH), height * rows + 0.4)
    return figure, [figure.add_subplot(rows, columns, place + 1) for place in range(panels)]


def dress(axes: Axes) -> None:
    """Quiet frame and grid."""
    axes.grid(color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=9, length=3)
    for side, spine in axes.spines.items():
        spine.set_visible(side in {"left", "bottom"})
        spine.set_color(FRAME)


def svg(figure: Figure) -> bytes:
    """As SVG; the same figure is the same bytes."""
    file = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "cab-forecast"}):
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    return file.getvalue()


def png(figure: Figure) -> bytes:
    """As PNG."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DOTS_PER_INCH)
    return file.getvalue()
