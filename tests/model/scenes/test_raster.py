from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from model.arrays import Bytes, Float32s, Floats, Ints
from model.geometry import rotate
from model.scenes.raster import (
    FAR,
    NEAR,
    PATCH_SIZE,
    MapView,
    PatchGeometry,
    cut_patches,
    cut_views,
    map_view,
)
from model.scenes.scene import Raster, Scene
from tests.model.made_scenes import crowd

VEHICLES = np.array([0, 1, 2])


def _smooth(points: Floats) -> Floats:
    """A smooth pattern over the plane: [..., 2] → [...]."""
    return np.sin(points[..., 0] / 3) * np.cos(points[..., 1] / 2)


def _raster(rows: int = 300, columns: int = 260, origin: tuple[float, float] = (0.0, 0.0)) -> Raster:
    """Three half planes' worth of noise."""
    layers = np.random.default_rng(3).integers(0, 2, (3, rows, columns), dtype=np.uint8)
    return Raster(layers, np.array(origin), 3.0)


def _single_pixel(row: int, column: int) -> Raster:
    layers = np.zeros((3, 200, 200), dtype=np.uint8)
    layers[1, row, column] = 1
    return Raster(layers, np.array([10.0, 20.0]), 3.0)


def test_shape_and_range() -> None:
    patches = cut_patches(_raster(), np.array([[40.0, 40.0], [50.0, 30.0]]), np.array([0.1, 2.0]))
    assert patches.shape == (2, 3, PATCH_SIZE, PATCH_SIZE)
    assert patches.dtype == np.float32
    assert patches.min() >= 0
    assert patches.max() <= 1


@pytest.mark.parametrize(
    ("heading", "pixel", "row", "column"),
    [
        (0.0, (115, 100), 25, 50),  # 5 m ahead
        (0.0, (100, 112), 10, 62),  # 4 m to the left
        (0.0, (91, 100), 1, 50),  # 3 m behind
        (np.pi / 2, (100, 115), 25, 50),  # looking along y: 5 m ahead
        (np.pi / 2, (88, 100), 10, 62),  # its left is −x
        (np.pi, (85, 100), 25, 50),
    ],
)
def test_a_known_pixel_lands_where_it_should(
    heading: float, pixel: tuple[int, int], row: int, column: int
) -> None:
    raster = _single_pixel(*pixel)
    position = raster.origin + np.array([100, 100]) / 3.0
    patch = cut_patches(raster, position[None], np.array([heading]))[0]
    assert np.unravel_index(patch[1].argmax(), patch[1].shape) == (row, column)
    assert patch[1, row, column] == pytest.approx(1, abs=1e-3)
    assert patch[1].sum() == pytest.approx(1, abs=1e-2)
    assert patch[0].max() == patch[2].max() == 0


def test_between_pixels_it_is_bilinear() -> None:
    raster = _single_pixel(115, 100)
    position = raster.origin + np.array([100.25, 100.5]) / 3.0
    patch = cut_patches(raster, position[None], np.zeros(1))[0, 1]
    assert patch[24, 50] == pytest.approx(0.25 * 0.5, abs=1e-4)
    assert patch[25, 49] == pytest.approx(0.75 * 0.5, abs=1e-4)


def test_outside_is_zero() -> None:
    raster = Raster(np.ones((3, 60, 60), dtype=np.uint8), np.zeros(2), 3.0)
    patch = cut_patches(raster, np.array([[10.0, 10.0]]), np.zeros(1))[0]
    # The raster ends 29 rows ahead, and 29 columns to the left and 30 to the right of pixel (30, 30)
    assert (patch[:, :40, 20:80] > 0.999).all()
    assert (patch[:, 40:] < 1e-3).all()
    assert (patch[:, :, :20] < 1e-3).all()
    assert (patch[:, :, 80:] < 1e-3).all()


@pytest.mark.parametrize("position", [(-1e7, 3.0), (1e7, 1e7), (40.0, -40.0), (140.0, 40.0)])
def test_agents_off_the_map_see_nothing_and_harm_nobody(position: tuple[float, float]) -> None:
    inside, heading = np.array([40.0, 40.0]), np.array([0.3, 0.0, 0.3])
    patches = cut_patches(_raster(), np.array([inside, position, inside]), heading)
    assert not patches[1].any()
    np.testing.assert_array_equal(patches[0], patches[2])
    np.testing.assert_allclose(patches[0], cut_patches(_raster(), inside[None], heading[:1])[0], atol=1e-4)


def test_nobody_on_the_map_and_no_agents() -> None:
    assert not cut_patches(_raster(), np.array([[500.0, 0.0]]), np.zeros(1)).any()
    assert cut_patches(_raster(), np.zeros((0, 2)), np.zeros(0)).shape == (0, 3, 100, 100)


@pytest.mark.parametrize("shape", [(1, 50), (50, 1), (1, 1)])
def test_a_raster_one_pixel_wide(shape: tuple[int, int]) -> None:
    raster = Raster(np.ones((3, *shape), dtype=np.uint8), np.zeros(2), 3.0)
    patch = cut_patches(raster, np.zeros((1, 2)), np.zeros(1))[0]
    assert patch[0, 10, 50] == pytest.approx(1)
    assert patch[0].sum() == pytest.approx(shape[0] * shape[1], rel=1e-3)


@pytest.mark.parametrize(("x", "heading"), [(np.nan, 0.0), (np.inf, 0.0), (0.0, np.nan)])
def test_what_is_not_finite_is_refused(x: float, heading: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        cut_patches(_raster(), np.array([[x, 0.0]]), np.array([heading]))


@settings(max_examples=25, deadline=None)
@given(
    x=st.floats(20, 70),
    y=st.floats(20, 60),
    heading=st.floats(-10, 10),
    dx=st.floats(-1e5, 1e5),
    dy=st.floats(-1e5, 1e5),
)
def test_moving_the_world_changes_nothing(x: float, y: float, heading: float, dx: float, dy: float) -> None:
    angle = np.array([heading])
    here = cut_patches(_raster(), np.array([[x, y]]), angle)
    there = cut_patches(_raster(origin=(dx, dy)), np.array([[x + dx, y + dy]]), angle)
    np.testing.assert_allclose(here, there, atol=1e-3)


@settings(max_examples=25, deadline=None)
@given(row=st.integers(110, 190), column=st.integers(110, 190), heading=st.floats(-4, 4))
def test_turning_the_world_by_a_right_angle_changes_nothing(row: int, column: int, heading: float) -> None:
    raster = _raster(300, 300)
    # [rows = x, columns = y]: the point (x, y) goes to (−y, x), and so to row 299 − column
    turned = Raster(np.flip(raster.layers.transpose(0, 2, 1), 1).copy(), raster.origin, 3.0)
    here = cut_patches(raster, np.array([[row, column]]) / 3, np.array([heading]))
    there = cut_patches(turned, np.array([[299 - column, row]]) / 3, np.array([heading + np.pi / 2]))
    np.testing.assert_allclose(here, there, atol=1e-3)


@pytest.mark.parametrize("pixels_per_meter", [1.5, 3.0, 10.0])
@pytest.mark.parametrize("heading", [0.0, 0.7, -2.5])
def test_resolution_and_heading_against_the_formula(pixels_per_meter: float, heading: float) -> None:
    size = int(90 * pixels_per_meter)
    origin, position = np.array([1000.0, -500.0]), np.array([1041.3, -456.2])
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size), indexing="ij"), axis=-1)
    layer = _smooth(grid / pixels_per_meter) > 0
    raster = Raster(np.stack([layer] * 3).astype(np.uint8), origin, pixels_per_meter)
    patch = cut_patches(raster, position[None], np.array([heading]))[0, 0]
    i, j = np.meshgrid(np.arange(100), np.arange(100), indexing="ij")
    points = position + rotate(np.stack([(i - 10) / 3, (j - 50) / 3], axis=-1), np.array(heading))
    value = _smooth(points - origin)
    sure = np.abs(value) > 0.35  # away from the pattern's edges, where the raster's pixels decide
    np.testing.assert_allclose(patch[sure], (value > 0)[sure], atol=1e-5)


def test_golden_patches(shared: Path) -> None:
    golden = np.load(shared / "reference/golden/map/patches.npz")
    maps = shared / "data/nuscenes_pred/map_0.1"
    exact, truncated = [], []
    for patch, scene, pose in zip(golden["patch"], golden["scene"], golden["pose_xy_yaw"], strict=True):
        # The files are for cv2.imread, whose channels run blue, green, red; Pillow's run the other way
        image = np.asarray(Image.open(maps / f"{scene}.png"))[..., ::-1]
        x, y, scale = map(float, (maps / f"meta_{scene}.txt").read_text().split())
        raster = Raster((image.transpose(2, 0, 1) > 127).astype(np.uint8), np.array([x, y]), scale)
        exact.append(np.abs(cut_patches(raster, pose[None, :2], pose[2:])[0] - patch).mean())
        pixel = raster.origin + np.trunc((pose[:2] - raster.origin) * scale) / scale
        truncated.append(np.abs(cut_patches(raster, pixel[None], pose[2:])[0] - patch).mean())
    assert np.mean(exact) <= 0.01
    assert np.mean(truncated) <= 0.003


@pytest.mark.parametrize("pixels_per_meter", [3.0, 6.0, 10.0, 30.0])
def test_a_line_of_one_pixel_stays_in_the_patch_however_fine_the_raster(pixels_per_meter: float) -> None:
    size = int(60 * pixels_per_meter)
    layers = np.zeros((3, size, size), dtype=np.uint8)
    layers[1, :, size // 2 + int(2 * pixels_per_meter)] = 1  # along x, 2 m to the left of the middle
    raster = Raster(layers, np.array([-30.0, -30.0]), pixels_per_meter)
    patch = cut_patches(raster, np.array([[0.0, 0.0]]), np.array([0.0]))[0, 1]
    drawn = patch[10:90].max(axis=1)
    assert (drawn > 0.45).all(), drawn.min()
    columns = patch[10:90].argmax(axis=1)
    assert (np.abs(columns - 56) <= 1).all()  # 2 m · 3 px/m left of column 50


@pytest.mark.parametrize(
    ("heading", "ahead", "left", "row", "column"),
    [(0.0, 30.0, 0.0, 56, 50), (0.0, 0.0, -20.0, 14, 22), (np.pi / 2, 60.0, 30.0, 98, 92)],
)
def test_where_a_far_patch_shows_what(
    heading: float, ahead: float, left: float, row: int, column: int
) -> None:
    layers = np.zeros((3, 600, 600), dtype=np.uint8)
    position = np.array([100.0, 100.0])
    point = position + rotate(np.array([ahead, left]), np.array(heading))
    at = np.round(point * 3.0).astype(int)
    layers[0, at[0] - 1 : at[0] + 2, at[1] - 1 : at[1] + 2] = 1  # a metre wide: wider than a patch's pixel
    patch = cut_patches(Raster(layers, np.zeros(2), 3.0), position[None], np.array([heading]), FAR)[0]
    assert np.unravel_index(patch[0].argmax(), patch[0].shape) == (row, column)
    assert patch[0, row, column] > 0.9
    assert not patch[1:].any()


@settings(max_examples=20, deadline=None)
@given(
    x=st.floats(95, 105), y=st.floats(95, 105), heading=st.floats(-4, 4), scale=st.sampled_from([1.0, 3.0])
)
def test_a_far_patch_shows_nothing_beyond_74_m(x: float, y: float, heading: float, scale: float) -> None:
    size = int(200 * scale)
    grid = np.stack(np.meshgrid(np.arange(size), np.arange(size), indexing="ij"), axis=-1) / scale
    beyond = np.hypot(grid[..., 0] - x, grid[..., 1] - y) > 74.0
    rng = np.random.default_rng(0)
    one, other = rng.integers(0, 2, (2, 3, size, size), dtype=np.uint8)
    other = np.where(beyond, other, one)
    assert (other != one).any()
    position, angle = np.array([[x, y]]), np.array([heading])
    seen, same = (
        cut_patches(Raster(layers, np.zeros(2), scale), position, angle, FAR, outside=0.5)
        for layers in (one, other)
    )
    np.testing.assert_array_equal(seen, same)


@pytest.mark.parametrize("geometry", [NEAR, FAR])
def test_what_lies_outside_the_raster_is_what_is_asked_for(geometry: PatchGeometry) -> None:
    raster = Raster(np.ones((3, 60, 60), dtype=np.uint8), np.zeros(2), 3.0)
    position = np.array([[10.0, 10.0], [500.0, 0.0]])
    patches = cut_patches(raster, position, np.zeros(2), geometry, outside=0.5)
    assert (patches[1] == 0.5).all()
    # The raster's edge is 9.7 m ahead, behind and to the left, 10 m to the right of the first agent
    row = geometry.rows_behind + int(11 * geometry.pixels_per_meter)
    np.testing.assert_allclose(patches[0, :, row:], 0.5, atol=1e-5)
    near = int(8 * geometry.pixels_per_meter)
    inside = patches[0, :, geometry.rows_behind : geometry.rows_behind + near, 50 - near : 50 + near]
    np.testing.assert_allclose(inside, 1.0, atol=1e-5)


@pytest.mark.parametrize(("geometry", "pixels_per_meter"), [(FAR, 3.0), (FAR, 10.0), (NEAR, 10.0)])
def test_a_patch_does_not_hang_on_whose_else_are_cut(
    geometry: PatchGeometry, pixels_per_meter: float
) -> None:
    layers = np.random.default_rng(3).integers(0, 2, (3, 900, 900), dtype=np.uint8)
    raster = Raster(layers, np.array([5.0, -3.0]), pixels_per_meter)
    middle = raster.origin + 450 / pixels_per_meter
    others = middle + np.array([[-7.0, -4.1], [-3.3, 2.6], [6.1, 1.7]])
    heading = np.array([0.3, 2.0, -1.0, 0.7])
    alone = cut_patches(raster, middle[None], heading[:1], geometry)[0]
    for count in (1, 2, 3):
        position = np.concatenate([middle[None], others[:count]])
        together = cut_patches(raster, position, heading[: 1 + count], geometry)
        np.testing.assert_allclose(together[0], alone, atol=2e-3)


def _views(outside: float) -> list[MapView]:
    """Views of one, two and no agents: on rasters of different sizes and resolutions, beside them, of given
    patches, and without a raster."""
    scene = crowd()
    bare = Scene(scene.types, scene.states)
    fine = Raster(_raster().layers, np.array([-40.0, -30.0]), 7.0)
    beside = Raster(_raster().layers, np.array([500.0, 0.0]), 3.0)
    given: dict[int, Bytes | Float32s] = {int(VEHICLES[0]): np.eye(100, dtype=np.uint8)[None].repeat(3, 0)}

    def view(raster: Raster | None, targets: Ints, patches: dict[int, Bytes | Float32s]) -> MapView:
        return map_view(replace(bare, raster=raster), targets, patches, FAR, outside)

    one, two = VEHICLES[:1], VEHICLES[:2]
    small = Raster(np.ones((3, 4, 9), dtype=np.uint8), np.zeros(2), 0.5)
    wholes = [
        view(raster, targets, {}) for raster in (_raster(), fine, small, beside) for targets in (one, two)
    ]
    return [
        *wholes,
        view(None, one, {}),
        view(fine, two, given),
        view(fine, one, given),
        view(fine, one[:0], {}),
    ]


@pytest.mark.parametrize("outside", [0.0, 0.5])
def test_views_cut_together_have_the_patches_of_each(outside: float) -> None:
    views = _views(outside)
    for together, view in zip(cut_views(views), views, strict=True):
        assert together.shape == (len(view), 3, FAR.size, FAR.size)
        np.testing.assert_allclose(together, view.cut(), atol=2e-3)


def test_a_part_of_a_view_has_the_patches_of_its_agents() -> None:
    view = _views(0.5)[-3]
    assert view.given
    whole = view.cut()
    np.testing.assert_allclose(np.concatenate([view[:1].cut(), view[1:].cut()]), whole, atol=1e-5)
    assert (view[:1].cut() != view[1:].cut()).any()


def test_a_view_takes_a_small_part_of_the_memory_of_its_patches() -> None:
    raster = Raster(np.ones((3, 400, 400), dtype=np.uint8), np.array([-200.0, -200.0]), 1.0)
    view = map_view(replace(crowd(), raster=raster), VEHICLES, {}, NEAR, 0.5)
    assert view.layers is not None
    assert np.shares_memory(view.layers, raster.layers)
    assert 50 * (view.center.nbytes + view.heading.nbytes) < view.cut().nbytes
