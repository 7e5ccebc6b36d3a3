"""Cases in which the bundled model is known to be out of its band.

They are strict expected failures: a model that passes one must remove it from this list. The bands themselves
do not depend on it.
"""

OUTSIDE: dict[str, frozenset[str]] = {
    "row": frozenset(
        {
            "standing, 1 cm, 5 Hz",
            "sideways 2 cm/s, 2 Hz",
            "sideways -2 cm/s",
            "straight 9",
            "straight 12, 20 Hz",
            "straight 9, 8 cm, 20 Hz",
            "highway 37",
            "accelerating 2.2",
            "junction in 22 m",
            "junction in 30 m",
            "lead in 24 m",
            "lead in 29 m",
        }
    ),
    "width": frozenset(),
    "modes": frozenset(
        {
            "braking 2.7",
        }
    ),
    "shared row": frozenset(
        {
            "standing_sideways_2cms",
            "highway_33",
            "accelerating_2",
            "curve_R55_entry",
            "lead_stands",
        }
    ),
    "shared modes": frozenset(),
    "drive": frozenset(
        {
            "100 ticks, straight on",
            "100 ticks, into a curve",
        }
    ),
    "turned": frozenset(
        {
            "raster",
        }
    ),
}
"""Names of scenes, drives and views, by test."""
