import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.metrics.path_fan import CURVATURES, on_road_path_exists, path_fan
from model.scenes.scene import Raster

STEPS = 12
HERE = np.array([1000.0, 2000.0])


def road(turned: bool = False) -> Raster:
    """A road of 6 m along x, 100 m to each side of ``HERE``, or along y."""
    layers = np.zeros((3, 200, 200), dtype=np.uint8)
    if turned:
        layers[0, 97:104] = 1
    else:
        layers[0, :, 97:104] = 1
    return Raster(layers, HERE - 100, 1.0)


def test_paths_have_the_speed_and_a_constant_curvature() -> None:
    paths = path_fan(np.zeros(2), 0.0, 5.0, STEPS)
    chords = np.linalg.norm(np.diff(paths, axis=1, prepend=0.0), axis=-1)
    assert (chords <= 0.5 * (5 + 2 * 6) + 1e-9).all()
    steady = np.isclose(chords[:, 0], chords[:, -1]) & (chords[:, 0] > 0)
    straight = paths[steady & (np.abs(paths[:, -1, 1]) < 1e-9)]
    np.testing.assert_allclose(straight[0][:, 0], 2.5 * np.arange(1, STEPS + 1))
    for path in paths[np.abs(paths[:, -1, 1]) > 1]:
        radius = (path**2).sum(axis=-1) / (2 * path[:, 1])  # of circles through the origin along x
        np.testing.assert_allclose(radius, radius[-1], rtol=1e-6)
        assert np.isclose(1 / CURVATURES[CURVATURES != 0], radius[-1], rtol=1e-6).any()


def test_who_brakes_stops_and_does_not_reverse() -> None:
    paths = path_fan(np.zeros(2), 0.0, 3.0, STEPS)
    straight = paths[(np.abs(paths[..., 1]) < 1e-9).all(axis=1)]
    assert (np.diff(straight[..., 0], axis=1) >= 0).all()
    assert straight[:, -1, 0].min() == pytest.approx(1.5)  # 3 m/s against 3 m/s²
    standing = path_fan(HERE, 1.0, 0.0, STEPS)
    assert (standing == HERE).all(axis=(1, 2)).any()


def test_no_path_is_tighter_than_its_speed_allows() -> None:
    slow, fast = (len(path_fan(np.zeros(2), 0.0, speed, STEPS)) for speed in (1.0, 30.0))
    assert slow > fast > 0


@pytest.mark.parametrize(("turned", "heading", "speed", "exists"), [
    (False, 0.0, 10.0, True),
    (True, np.pi / 2, 10.0, True),
    (True, 0.0, 10.0, False),  # it would have to stop within 3 m, or turn at 6 m/s²
    (True, 0.0, 1.0, True),
    (False, 0.0, 30.0, False),  # the road ends
])  # fmt: skip
def test_a_path_on_the_road(turned: bool, heading: float, speed: float, exists: bool) -> None:
    assert on_road_path_exists(road(turned), HERE, heading, speed, STEPS) is exists


@given(st.floats(-4, 4), st.floats(0, 20))
def test_paths_turn_and_move_with_the_agent(heading: float, speed: float) -> None:
    cos, sin = np.cos(heading), np.sin(heading)
    there = path_fan(HERE, heading, speed, STEPS)
    back = (there - HERE) @ np.array([[cos, -sin], [sin, cos]])
    np.testing.assert_allclose(back, path_fan(np.zeros(2), 0.0, speed, STEPS), atol=1e-6)
