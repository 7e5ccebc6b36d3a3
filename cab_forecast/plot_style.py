"""Colours and sizes of the picture."""

from typing import Final

GROUND: Final = "#eef0ec"
DRIVEABLE: Final = "#d3d7dd"
ROAD_DIVIDER: Final = "#d99a1c"
LANE_DIVIDER: Final = "#ffffff"
INK: Final = "#22303c"
WRONG: Final = "#8c8c8c"

TYPE_COLORS: Final = {
    "vehicle": "#1f5fae",
    "pedestrian": "#c8374a",
    "cyclist": "#1d8a4b",
    "unknown": "#7b4ba6",
    "unspecified": "#7b4ba6",
}
NOMINAL_SIZES: Final = {
    "vehicle": (4.6, 1.9),
    "cyclist": (1.8, 0.7),
}
"""Length and width, m, of the types drawn as boxes. The contract carries no sizes."""
NOMINAL_RADIUS: Final = 0.45
"""m, of the types drawn as discs."""
