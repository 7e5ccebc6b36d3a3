"""Moves of maps, tracks and points."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from benchmark.context.moves import Move, Pose
from model.metrics.offroad import driveable
from model.scenes.scene import Raster
from tests.model.data.records import raster, track

COORDINATE = st.floats(-500, 500)
POSES = st.builds(
    lambda x, y, heading: Pose(np.array([x, y]), heading), COORDINATE, COORDINATE, st.floats(-4, 4)
)
SOURCE = Pose(np.array([1001.3, 2000.7]), 0.4)
"""A pose on the noise of ``raster``."""


@given(POSES, POSES)
def test_a_move_takes_its_source_to_its_target_and_back(source: Pose, target: Pose) -> None:
    move = Move(source, target)
    ahead = np.array([[0.0, 0.0], [10 * np.cos(source.heading), 10 * np.sin(source.heading)]])
    moved = move.points(source.position + ahead)
    np.testing.assert_allclose(moved[0], target.position, atol=1e-9)
    step = 10 * np.array([np.cos(target.heading), np.sin(target.heading)])
    np.testing.assert_allclose(moved[1] - moved[0], step, atol=1e-9)
    np.testing.assert_allclose(move.inverse.points(moved), source.position + ahead, atol=1e-9)


def test_a_moved_track_keeps_its_shape_and_comes_later() -> None:
    given_track = track("one", [[0, 0], [5, 0], [10, 1]], [0.0, 0.1, 0.2])
    move = Move(Pose(np.array([5.0, 0.0]), 0.1), Pose(np.array([-30.0, 7.0]), 3.1))
    moved = move.track(given_track, "other", 20)
    assert (moved.id, moved.frames.tolist()) == ("other", [20, 21, 22])
    np.testing.assert_allclose(moved.position[1], [-30, 7])
    np.testing.assert_allclose(np.diff(moved.heading) % (2 * np.pi), [0.1, 0.1])
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(moved.position, axis=0), axis=1),
        np.linalg.norm(np.diff(given_track.position, axis=0), axis=1),
    )


@given(POSES)
def test_a_moved_map_shows_what_the_map_shows_there(target: Pose) -> None:
    given_map, move = raster(), Move(SOURCE, target)
    moved = move.raster(given_map, 20.0)
    points = SOURCE.position + np.random.default_rng(0).uniform(-14, 14, (500, 2))
    # Noise in blocks of four pixels: a point that is a pixel or more from an edge shows the same
    inner = np.ones(len(points), dtype=np.bool_)
    for offset in (
        (0.4, 0),
        (-0.4, 0),
        (0, 0.4),
        (0, -0.4),
        (0.3, 0.3),
        (0.3, -0.3),
        (-0.3, 0.3),
        (-0.3, -0.3),
    ):
        inner &= driveable(given_map, points + offset) == driveable(given_map, points)
    assert inner.sum() > 50
    seen = driveable(moved, move.points(points))
    np.testing.assert_array_equal(seen[inner], driveable(given_map, points)[inner])


def test_a_move_without_a_turn_changes_no_pixel() -> None:
    given_map = raster()
    moved = Move(SOURCE, Pose(SOURCE.position + 100, SOURCE.heading)).raster(given_map, 10.0)
    offset = (moved.origin - 100 - given_map.origin) * given_map.pixels_per_meter
    np.testing.assert_allclose(offset, np.rint(offset), atol=1e-6)
    row, column = np.rint(offset).astype(int)
    size = moved.layers.shape[1]
    np.testing.assert_array_equal(moved.layers, given_map.layers[:, row : row + size, column : column + size])


def test_nothing_is_driveable_beyond_a_map() -> None:
    tiny = Raster(np.ones((3, 3, 3), dtype=np.uint8), np.zeros(2), 1.0)
    moved = Move(Pose(np.array([1.0, 1.0]), 0.0), Pose(np.zeros(2), 0.0)).raster(tiny, 5.0)
    assert moved.layers.shape == (3, 11, 11)
    assert moved.layers[0].sum() == 9
