"""Drives of 100 ticks at 10 Hz, in which the most likely forecast for a given time must not jump."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.arrays import Floats
from tests.cases import roads
from tests.cases.bands import Reading
from tests.cases.case import Scenario
from tests.cases.checks import LocalForecast, jumps
from tests.cases.scenes import LANE, RATE, STOP_X, left_arc, line, ticks

COUNT = 100
_OUTER = -1.5 * LANE


@dataclass(frozen=True)
class Drive:
    """Successive scenes of one car, and the bands of its forecasts' jumps."""

    name: str
    ticks: Sequence[Scenario]
    median: float
    """Max median of the jumps, m."""
    largest: float
    """Max jump, m."""

    def readings(self, found: Sequence[LocalForecast]) -> list[Reading]:
        """Return the readings of the forecasts of all ticks, in order."""
        paths: Floats = np.stack([one.frame.to_ground(one.likeliest) for one in found])
        sizes = jumps(paths, 1 / RATE)
        return [
            Reading("ML at 6 s jumps, median", float(np.median(sizes)), high=self.median),
            Reading("ML at 6 s jumps, largest", float(sizes.max()), high=self.largest),
        ]


def drives() -> list[Drive]:
    """Return the drives: straight on and from a straight road into a curve with 5 cm and 0.02 rad of noise,
    and waiting at a red light with 3 cm and 0.01 rad."""
    rough, still = {"noise": 0.05, "heading_noise": 0.02}, {"noise": 0.03, "heading_noise": 0.01}
    bend = left_arc(np.array([0.0, _OUTER]), 60.0 - _OUTER, -50.0)
    wait = line(STOP_X, -LANE / 2)
    return [
        Drive(
            "100 ticks, straight on",
            ticks(line(0.0, _OUTER), 9.5, roads.straight(2, LANE), COUNT, **rough),
            median=1.0,
            largest=4.0,
        ),
        Drive(
            "100 ticks, into a curve",
            ticks(bend, 9.5, roads.curve(60.0, 2, LANE), COUNT, **rough),
            median=1.0,
            largest=4.0,
        ),
        Drive(
            "100 ticks, red light",
            ticks(wait, 0.0, roads.junction(2, LANE, 5.0), COUNT, **still),
            median=1.0,
            largest=1.0,
        ),
    ]
