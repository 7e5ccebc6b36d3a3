"""The simulated scenes of the demo, by name."""

from collections.abc import Callable, Mapping

from cab_forecast.demo.highway import highway
from cab_forecast.demo.junction import junction
from cab_forecast.demo.roundabout import roundabout
from cab_forecast.demo.world import World

SCENES: Mapping[str, Callable[[], World]] = {
    "junction": junction,
    "roundabout": roundabout,
    "highway": highway,
}
