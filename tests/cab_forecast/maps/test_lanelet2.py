"""Lanelet2 maps."""

from pathlib import Path

import numpy as np
import pytest

from cab_forecast.maps import MapError, read_map
from cab_forecast.maps.projection import UtmProjection
from tests.cab_forecast.maps.samples import foreign

lanelet2 = pytest.importorskip("lanelet2", reason="lanelet2 has wheels for Linux on x86-64 only")

ORIGIN = (49.0, 8.4)
BORDERS = (0.0, 3.0, 6.0, 9.0)
"""y of the borders of three lanes side by side, m; x goes from 0 to 50."""


def written(folder: Path, *, local: bool, kinds: tuple[str, ...] = ("dashed",) * 4) -> Path:
    """Write a map of three lanelets: the two right ones go along x, the left one against it."""
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(*ORIGIN))
    lines = ['<osm version="0.6">']
    for row, y in enumerate(BORDERS):
        for end, x in enumerate((0.0, 50.0)):
            place = projector.reverse(lanelet2.core.BasicPoint3d(x, y, 0.0))
            tags = f'<tag k="local_x" v="{x + 1000}"/><tag k="local_y" v="{y}"/>' if local else ""
            lines.append(
                f'<node id="{10 * row + end + 1}" lat="{place.lat:.12f}" lon="{place.lon:.12f}">{tags}</node>'
            )
    for row, kind in enumerate(kinds):
        line = "virtual" if kind == "virtual" else "line_thin"
        tags = f'<tag k="type" v="{line}"/><tag k="subtype" v="{kind}"/>'
        refs = f'<nd ref="{10 * row + 1}"/><nd ref="{10 * row + 2}"/>'
        lines.append(f'<way id="{100 + row}">{refs}{tags}</way>')
    for row, (left, right) in enumerate(((101, 100), (102, 101), (102, 103))):
        members = (
            f'<member type="way" ref="{left}" role="left"/><member type="way" ref="{right}" role="right"/>'
        )
        tags = "".join(
            f'<tag k="{key}" v="{value}"/>'
            for key, value in (
                ("type", "lanelet"),
                ("subtype", "road"),
                ("location", "urban"),
                ("one_way", "yes"),
            )
        )
        lines.append(f'<relation id="{200 + row}">{members}{tags}</relation>')
    path = folder / "street.osm"
    path.write_text("\n".join([*lines, "</osm>"]), encoding="utf-8")
    return path


@pytest.mark.parametrize("local", [False, True])
def test_lanelets_and_the_lines_between_them(tmp_path: Path, local: bool) -> None:
    path = written(tmp_path, local=local)
    vector_map = read_map(path, origin=None if local else ORIGIN)
    assert vector_map.counts == {"driveable_area": 3, "road_dividers": 1, "lane_dividers": 1}
    start = 1010.0 if local else 10.0
    area, roads, lanes = vector_map.layers((start, -1.0 + 0.01), 10, 33, 3.0)
    assert np.flatnonzero(area[5]).tolist() == list(range(3, 30))  # y = 0 … 9 m
    assert np.flatnonzero(lanes[5]).tolist() == [11, 12]  # y = 3 m
    assert np.flatnonzero(roads[5]).tolist() == [20, 21]  # y = 6 m


def test_virtual_lines_are_no_dividers(tmp_path: Path) -> None:
    kinds = ("solid", "virtual", "dashed", "solid")
    vector_map = read_map(written(tmp_path, local=True, kinds=kinds))
    assert vector_map.counts == {"driveable_area": 3, "road_dividers": 1, "lane_dividers": 0}


def test_degrees_need_an_origin(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"lack the tags local_x and local_y.*origin=\(49\.0\d+, 8\.4\d+\)"):
        read_map(written(tmp_path, local=False))
    with pytest.raises(MapError, match="an origin is latitude"):
        read_map(written(tmp_path, local=False), origin=(8.4, 490.0))


def test_a_map_of_streets_only_has_no_driveable_area(tmp_path: Path) -> None:
    """OpenStreetMap's own files have the same suffix, but no lanelets."""
    path = tmp_path / "town.osm"
    path.write_text('<osm version="0.6"><node id="1" lat="49" lon="8"/></osm>', encoding="utf-8")
    with pytest.raises(MapError, match=r"town\.osm has no driveable area"):
        read_map(path, origin=ORIGIN)


@pytest.mark.parametrize("place", [(49.01, 8.42), (-33.9, 151.2), (1.3, 103.8), (37.0, -122.4)])
def test_the_frame_is_that_of_lanelet2(place: tuple[float, float]) -> None:
    """So maps in GeoJSON and Lanelet2 with the same origin lie on one another."""
    origin = (place[0] - 0.013, place[1] - 0.02)
    projected = UtmProjection(origin)(np.array([place[::-1]]))[0]
    theirs = lanelet2.projection.UtmProjector(lanelet2.io.Origin(*origin)).forward(
        lanelet2.core.GPSPoint(*place, 0.0)
    )
    np.testing.assert_allclose(projected, (theirs.x, theirs.y), atol=1e-3)


def test_a_foreign_map() -> None:
    vector_map = read_map(foreign("mapping_example.osm"), origin=(49.0, 8.4))
    assert vector_map.counts == {"driveable_area": 328, "road_dividers": 3, "lane_dividers": 83}
    # A roundabout with three lanes
    raster = vector_map.layers((1780.0, 345.0), 120, 120, 3.0)
    assert raster[0].mean() == pytest.approx(0.44, abs=0.1)
    assert raster[2].any()
