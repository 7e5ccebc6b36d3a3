"""Vector maps, and the rasters that are cut from them."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from cab.forecast.v1.prediction_service_pb2 import SceneRaster
from cab_forecast import predict_request, raster_digest
from cab_forecast.layers import decode_layers
from cab_forecast.maps import LAYERS, MapCutter, MapError, OffMapError, VectorMap, read_map
from cab_forecast.rasters import RasterDigests
from model.scenes.raster import cut_patches
from model.scenes.scene import Raster

ROAD = shapely.box(100.0, 50.0, 300.0, 60.0)


def road(**layers: Any) -> VectorMap:
    """Return a map of one road of 200 m along x."""
    return VectorMap({"driveable_area": [ROAD], **layers}, source="road.json")


def pixels(raster: SceneRaster) -> np.ndarray:
    return decode_layers(raster.image, raster.rows, raster.columns)


def test_pixels_lie_where_the_contract_says() -> None:
    line = [(150.0, 55.0), (250.0, 55.0)]
    raster = road(lane_dividers=[line]).cut((200.1, 55.2), size=60.0, pixels_per_meter=4.0)
    area, roads, lanes = pixels(raster)
    i, j = np.meshgrid(np.arange(raster.rows), np.arange(raster.columns), indexing="ij")
    x, y = raster.origin_x + i / 4.0, raster.origin_y + j / 4.0
    assert x.min() == pytest.approx(170.1)
    assert x.max() == pytest.approx(230.1)
    np.testing.assert_array_equal(area, (y > 50) & (y < 60))
    np.testing.assert_array_equal(lanes, np.abs(y - 55) < 1 / 3)
    assert not roads.any()
    assert raster.digest == raster_digest(raster)


@pytest.mark.parametrize("resolution", [0.5, 1.0, 3.0, 8.0])
@pytest.mark.parametrize("angle", [0.0, 0.3, 0.8, 1.4])
def test_dividers_have_no_gaps(resolution: float, angle: float) -> None:
    far = 80 * np.array([np.cos(angle), np.sin(angle)])
    middle = np.array([200.0, 55.0])
    line = np.stack([middle - far, middle + far])
    _, drawn, _ = pixels(road(road_dividers=[line]).cut((200, 55), 60.0, resolution))
    # Along the axis that the line rather follows, each row has pixels that touch those of the row before
    rows = drawn if abs(np.cos(angle)) > 0.7 else drawn.T
    assert all(one.any() for one in rows)
    for one, following in pairwise(rows):
        wide = np.convolve(one, [1, 1, 1], "same") > 0
        assert (wide & following).any()


def test_shapes_may_be_arrays_polygons_and_collections() -> None:
    corners = np.array([(0, 0, 9.0), (40, 0, 9.0), (40, 40, 9.0), (0, 40, 9.0)])  # z is left out
    two = shapely.MultiPolygon([shapely.box(50, 0, 90, 40), shapely.box(50, 50, 90, 90)])
    lines = shapely.MultiLineString([[(0, 20), (40, 20)], [(50, 20), (90, 20)]])
    vector_map = VectorMap(
        {"driveable_area": [corners, two, shapely.Polygon()], "road_dividers": [lines, [(0, 1), (40, 1)]]}
    )
    assert vector_map.counts == {"driveable_area": 3, "road_dividers": 3, "lane_dividers": 0}
    assert vector_map.extent.high.tolist() == [90, 90]


def test_overlapping_polygons_are_united() -> None:
    vector_map = VectorMap({"driveable_area": [shapely.box(0, 0, 20, 20), shapely.box(10, 0, 30, 20)]})
    area = pixels(vector_map.cut((15, 10), 12.0))[0]
    assert area.all()


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ({"walkway": []}, "road.json has no layer 'walkway': layers are driveable_area, road_div"),
        ({"driveable_area": []}, "road.json has no driveable area"),
        ({}, "no driveable area, without which models take every agent for off the road"),
        ({"driveable_area": [shapely.LineString([(0, 0), (9, 9)])]}, r"needs a Polygon.*line\.buffer"),
        ({"driveable_area": [ROAD], "lane_dividers": [ROAD]}, "lane_dividers of .* needs a LineString, but"),
        ({"driveable_area": [[(0, 0), (1, 1)]]}, r"needs \[V, 2\] with V ≥ 3, but has \[2, 2\]"),
        ({"driveable_area": [[(0, 0), (1, 1), (np.nan, 2)]]}, "coordinate that is not finite"),
        ({"driveable_area": [shapely.box(3e7, 0, 3e7 + 50, 50)]}, "beyond ±1e\\+07 m.*Shift it"),
    ],
)
def test_maps_that_cannot_be_used_say_why(layers: Any, message: str) -> None:
    with pytest.raises(MapError, match=message):
        VectorMap(layers, source="road.json")


def test_degrees_are_told_from_metres() -> None:
    lanes = [shapely.box(8.42 + n * 1e-4, 49.0, 8.42 + n * 1e-4 + 5e-5, 49.0002) for n in range(9)]
    with pytest.raises(MapError, match=r"look like degrees.*origin=\(49\.00010, 8\.4204"):
        VectorMap({"driveable_area": lanes})
    # A small map in metres
    assert VectorMap({"driveable_area": [shapely.box(0, 0, 3, 2)]}).counts["driveable_area"] == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((200, 55), 0.0), "must be above 0"),
        (((200, 55), 2000.0), "at most 1365 m"),
        (((200, 55), 60.0, 0.01), "within 0.1 … 100"),
        (((np.nan, 55), 60.0), "must be x and y"),
        ((200.0, 60.0), "must be x and y"),
    ],
)
def test_cuts_that_cannot_be_made_say_why(arguments: Any, message: str) -> None:
    with pytest.raises(MapError, match=message):
        road().cut(*arguments)


def test_a_position_off_the_map_says_where_the_map_is() -> None:
    with pytest.raises(
        OffMapError, match=r"within 150 m of \(900\.0, 55\.0\): road\.json has it at x 100\.0 … 3"
    ):
        road().cut((900, 55))


def test_the_anchor_lies_on_the_road() -> None:
    ring = shapely.Point(0, 0).buffer(50).difference(shapely.Point(0, 0).buffer(40))
    anchor = VectorMap({"driveable_area": [ring]}).anchor()
    assert ring.contains(shapely.Point(anchor))


class TestCutter:
    """Cuts are the same as long as a vehicle stays near."""

    def test_positions_of_a_cell_get_the_same_raster(self) -> None:
        cutter = MapCutter(road(), size=100.0, step=20.0)
        assert cutter.around(201, 55) is cutter.around(208, 52)
        other = cutter.around(215, 55)
        assert other.digest != cutter.around(201, 55).digest

    def test_a_cut_reaches_as_far_as_promised(self) -> None:
        cutter = MapCutter(road(), size=100.0, step=20.0)
        for x in np.linspace(150, 250, 37):
            raster = cutter.around(float(x), 57.0)
            assert raster.origin_x <= x - 40
            assert raster.origin_x + (raster.rows - 1) / 3.0 >= x + 40

    def test_clients_send_a_cut_once(self) -> None:
        cutter, digests = MapCutter(road(), size=100.0, step=20.0), RasterDigests()
        named = []
        for x in (201.0, 204.0, 208.0, 215.0, 219.0):
            request = predict_request(0.0, [], raster=cutter.around(x, 55.0))
            sending = digests.prepare(request)
            named.append(sending.named)
            digests.answered(sending)
        assert named == [False, True, True, False, True]

    def test_few_cuts_are_kept(self) -> None:
        cutter = MapCutter(road(), size=100.0, step=5.0)
        first = cutter.around(150, 55)
        for x in range(155, 250, 5):
            cutter.around(x, 55)
        again = cutter.around(150, 55)
        assert again is not first
        assert again == first

    def test_errors(self) -> None:
        with pytest.raises(MapError, match="below the size of 300 m"):
            MapCutter(road(), step=300.0)
        with pytest.raises(MapError, match="must be finite"):
            MapCutter(road()).around(float("nan"), 0.0)
        with pytest.raises(OffMapError):
            MapCutter(road()).around(9000.0, 0.0)


@pytest.mark.parametrize(
    ("scene", "location"),
    [
        ("scene-0065", "boston-seaport"),
        ("scene-0195", "singapore-onenorth"),
    ],
)
def test_cuts_of_nuscenes_are_the_maps_that_networks_were_trained_on(
    shared: Path, scene: str, location: str
) -> None:
    """Golden patches of the reference implementation, which rounds positions to whole pixels."""
    golden = np.load(shared / "reference/golden/map/patches.npz")
    mine = golden["scene"] == scene
    poses = golden["pose_xy_yaw"][mine]
    vector_map = read_map(shared / f"data/nuscenes/maps/expansion/{location}.json")
    raster = vector_map.cut(poses[:, :2].mean(axis=0))
    origin = np.array([raster.origin_x, raster.origin_y])
    scene_map = Raster(pixels(raster).astype(np.uint8), origin, raster.pixels_per_meter)
    patches = cut_patches(scene_map, poses[:, :2], poses[:, 2])
    difference = np.abs(patches - golden["patch"][mine]).mean(axis=(0, 2, 3))
    assert (difference < 0.025).all(), dict(zip(LAYERS, difference, strict=True))
    mirrored = cut_patches(scene_map, poses[:, :2], -poses[:, 2])
    assert np.abs(mirrored - golden["patch"][mine]).mean() > 2 * difference.mean()
