"""Pixels of polygons are those whose centres lie inside."""

import numpy as np
import shapely
import shapely.affinity
from hypothesis import given, settings
from hypothesis import strategies as st

from cab_forecast.maps.rasterize import fill

ROWS, COLUMNS = 12, 17
COORDINATE = st.floats(-6, 22, allow_nan=False)
HALVES = st.integers(-6, 40).map(lambda n: n / 2)
POINTS = st.lists(st.tuples(COORDINATE, COORDINATE), min_size=3, max_size=9, unique=True)


def filled(polygon: shapely.Polygon) -> np.ndarray:
    """Return the pixels of a polygon: [ROWS, COLUMNS]."""
    image = np.zeros((ROWS, COLUMNS), dtype=np.bool_)
    fill(image, [shapely.get_coordinates(ring) for ring in shapely.get_rings(polygon)])
    return image


def inside(polygon: shapely.Polygon, margin: float) -> np.ndarray:
    """Return the pixels whose centres lie inside by shapely, farther than the margin from the edge."""
    x, y = np.meshgrid(np.arange(ROWS), np.arange(COLUMNS), indexing="ij")
    with np.errstate(all="ignore"):  # GEOS divides by zero at short edges, and copes
        far = shapely.distance(polygon.boundary, shapely.points(x, y)) > margin
        return np.stack([shapely.contains_xy(polygon, x, y), far])


@settings(max_examples=60, deadline=None)
@given(POINTS)
def test_a_pixel_is_set_where_its_centre_lies_inside(points: list[tuple[float, float]]) -> None:
    polygon = shapely.Polygon(points)
    if not polygon.is_valid:
        polygon = polygon.convex_hull
    if polygon.geom_type != "Polygon":
        return
    expected, certain = inside(polygon, 1e-9)
    np.testing.assert_array_equal(filled(polygon)[certain], expected[certain])


@settings(max_examples=60, deadline=None)
@given(POINTS, st.floats(0.05, 0.9))
def test_holes_are_left_out(points: list[tuple[float, float]], share: float) -> None:
    hull = shapely.MultiPoint(points).convex_hull
    if hull.geom_type != "Polygon":
        return
    hole = shapely.affinity.scale(hull, share, share)
    polygon = shapely.Polygon(hull.exterior, [hole.exterior])
    expected, certain = inside(polygon, 1e-9)
    np.testing.assert_array_equal(filled(polygon)[certain], expected[certain])


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(HALVES, HALVES), min_size=4, max_size=4, unique=True))
def test_neighbours_have_neither_seams_nor_common_pixels(points: list[tuple[float, float]]) -> None:
    """Lanes side by side share edges, which here often pass through centres of pixels."""
    a, b, c, d = points
    first, second = shapely.Polygon([a, b, c]), shapely.Polygon([b, a, d])
    if min(first.area, second.area) == 0 or first.intersection(second).area > 0:
        return
    count = filled(first).astype(int) + filled(second)
    assert count.max() <= 1
    whole, certain = inside(first.union(second), 1e-9)
    np.testing.assert_array_equal(count[certain] == 1, whole[certain])


def test_a_fraction_of_a_pixel_counts() -> None:
    assert filled(shapely.box(2.01, 3.01, 4.99, 6.01)).sum() == 2 * 3
    assert filled(shapely.box(1.99, 2.99, 5.01, 6.01)).sum() == 4 * 4


def test_shapes_beyond_the_image_change_nothing() -> None:
    for box in ((-9, -9, -1, -1), (30, 2, 40, 3), (2, 30, 3, 40), (2.1, 3.1, 2.9, 3.9)):
        assert not filled(shapely.box(*box)).any()
    assert filled(shapely.box(-50, -50, 50, 50)).all()
