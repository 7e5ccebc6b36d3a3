import math

import numpy as np
import pytest

from cab_forecast import agent
from cab_forecast.maneuvers import current_heading, describe_maneuver, to_agent_frame

STEP = 0.5


def path(speeds: list[float], turn: float = 0.0, start: float = 0.0) -> np.ndarray:
    """Return twelve steps with linearly changing speed and a total turn in degrees."""
    speed = np.interp(np.linspace(0, len(speeds) - 1, 12), range(len(speeds)), speeds)
    angles = start + math.radians(turn) * np.arange(1, 13) / 12
    return np.cumsum(STEP * speed[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1), axis=0)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (path([10, 10]), "straight on"),
        (path([10, 10], turn=8), "straight on"),
        (path([10, 7.5]), "straight on"),  # Slower by a quarter
        (path([10, 4]), "straight on, slows to 4 m/s"),
        (path([1.2, 0.6]), "straight on"),  # By half, but of little
        (path([4, 8]), "straight on, speeds up to 8 m/s"),
        (path([6, 0]), "straight on, stops"),
        (path([5, 5], turn=30), "bears left 30°"),
        (path([5, 5], turn=-90), "turns right 90°"),
        (path([5, 2], turn=-90), "turns right 90°, slows to 2 m/s"),
        (path([5, 5], turn=200), "turns round left"),
        (path([0, 0]), "stays"),
        (path([0.15, 0.15]), "stays"),
        (path([0.4, 0.4]), "creeps, stops"),
        (path([0, 6]), "straight on, speeds up to 6 m/s"),
        (path([2, 2], start=math.pi), "backs up"),
        (path([2, 2], turn=40, start=math.pi), "backs up, turning 40°"),
        (path([2, 2], turn=-40, start=-math.pi), "backs up, turning 40°"),
    ],
)
def test_describe_maneuver(made: np.ndarray, words: str) -> None:
    assert describe_maneuver(made, STEP) == words


def test_to_agent_frame() -> None:
    looks_north = agent("a", "vehicle", [0.0], [[100.0, 200.0]], headings=[math.pi / 2])
    heading = current_heading(looks_north)
    assert heading == math.pi / 2
    points = np.array([[[100.0, 210.0], [97.0, 200.0]]])
    np.testing.assert_allclose(to_agent_frame(looks_north, heading, points), [[[10, 0], [0, 3]]], atol=1e-9)


def test_the_heading_is_that_of_motion_where_none_is_given() -> None:
    drives = agent("a", "vehicle", [0.0, 0.5, 1.0], [[0.0, 0.0], [0.0, -3.0], [0.05, -3.0]])
    heading = current_heading(drives)
    assert heading is not None
    assert heading == pytest.approx(-math.pi / 2, abs=0.02)
    assert current_heading(agent("a", "vehicle", [0.0, 0.5], [[0.0, 0.0], [0.1, 0.0]])) is None
