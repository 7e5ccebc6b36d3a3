"""Cases in which the bundled model is known to be out of its band.

They are strict expected failures: a model that passes one must remove it from this list. The bands themselves
do not depend on it.
"""

OUTSIDE: dict[str, frozenset[str]] = {
    "row": frozenset(
        {
            "standing, headings 3 cm",
            "sideways 2 cm/s, 2 Hz",
            "sideways -2 cm/s",
            "timestamps 30 ms off",
            "highway 37",
            "accelerating 1.7",
            "accelerating 2.2",
            "curve 62",
            "junction in 30 m",
            "lead in 29 m",
        }
    ),
    "width": frozenset(),
    "modes": frozenset(),
    "shared row": frozenset(
        {
            "standing_sideways_2cms",
            "accelerating_2",
            "junction_8_at_25m",
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
