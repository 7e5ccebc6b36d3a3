import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.metrics import offroad
from tests.model.metrics.builders import raster

ROAD = raster(np.array([[1, 1, 0], [1, 0, 0]], dtype=np.uint8), 2.0, (10.0, 20.0))
"""Half a metre a pixel."""


def test_the_nearest_pixel_counts() -> None:
    for ground, expected in (
        ((10.0, 20.0), True),
        ((10.0, 20.74), True),
        ((10.0, 20.76), False),
        ((10.24, 20.5), True),
        ((10.26, 20.5), False),
        ((10.5, 20.0), True),
        ((9.76, 19.76), True),
        ((9.74, 20.0), False),
        ((10.0, 19.74), False),
        ((10.76, 20.0), False),
        ((1e300, 20.0), False),
        ((np.nan, 20.0), False),
    ):
        assert offroad.driveable(ROAD, np.array(ground)) == expected, ground


def test_one_point_off_the_road_is_enough() -> None:
    on, off = [10.0, 20.0], [10.5, 20.5]
    trajectories = np.array([[on, on], [on, off], [off, on], [on, [np.nan, 0]], [off, [np.inf, 0]]])
    np.testing.assert_array_equal(offroad.off_road(ROAD, trajectories), [0, 1, 1, np.nan, np.nan])


def test_each_instance_on_its_own_map() -> None:
    trajectories = np.tile(np.array([10.0, 20.0]), (5, 2, 3, 1))
    trajectories[4, 1, 2] = 0
    elsewhere = raster(np.ones((2, 2), dtype=np.uint8))
    rasters = [ROAD, elsewhere, None, ROAD, ROAD]
    each = offroad.off_road_of_each(rasters, trajectories)
    np.testing.assert_array_equal(each, [[0, 0], [1, 1], [np.nan, np.nan], [0, 0], [0, 1]])
    np.testing.assert_array_equal(offroad.expected_off_road(rasters, trajectories), [0, 1, np.nan, 0, 0.5])
    with pytest.raises(ValueError, match="rasters"):
        offroad.off_road_of_each([ROAD], trajectories)


def test_a_map_without_pixels_has_no_road() -> None:
    assert not offroad.driveable(raster(np.zeros((0, 5), dtype=np.uint8)), np.zeros((3, 2))).any()


@given(st.integers(0, 10_000))
def test_pixels_are_where_the_raster_says(seed: int) -> None:
    rng = np.random.default_rng(seed)
    layer = rng.integers(0, 2, (7, 9)).astype(np.uint8)
    scale, origin = rng.uniform(0.5, 10), rng.uniform(-1e4, 1e4, 2)
    ij = np.stack(np.meshgrid(np.arange(7), np.arange(9), indexing="ij"), axis=-1)
    points = origin + (ij + rng.uniform(-0.49, 0.49, ij.shape)) / scale
    given_raster = raster(layer, scale, (origin[0], origin[1]))
    np.testing.assert_array_equal(offroad.driveable(given_raster, points), layer == 1)
