"""Scenes in which the bundled model is known to be out of its band.

Each is expected to fail, strictly: a model that mends one has to take it from here. What the bands are is no
matter of this list.
"""

OUTSIDE: dict[str, frozenset[str]] = {
    "row": frozenset(),
    "width": frozenset(),
    "modes": frozenset(),
    "shared row": frozenset(),
    "shared modes": frozenset(),
    "drive": frozenset(),
    "turned": frozenset(),
}
"""Names of scenes, drives and views by what is asked of them."""
