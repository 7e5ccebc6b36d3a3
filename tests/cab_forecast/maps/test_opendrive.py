"""OpenDRIVE maps."""

from pathlib import Path

import numpy as np
import pytest
import shapely

from cab_forecast.maps import MapError, read_map
from cab_forecast.maps.readers import opendrive
from tests.cab_forecast.maps.samples import foreign

LANES = """
<lanes><laneOffset s="0" a="0" b="0" c="0" d="0"/>
<laneSection s="0">
<left><lane id="2" type="sidewalk"><width sOffset="0" a="2" b="0" c="0" d="0"/></lane>
<lane id="1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left>
<center><lane id="0" type="none"><roadMark sOffset="0" type="solid"/></lane></center>
<right><lane id="-1" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/>
<roadMark sOffset="0" type="none"/><roadMark sOffset="10" type="broken"/></lane>
<lane id="-2" type="driving"><width sOffset="0" a="0" b="0.1" c="0" d="0"/>
<roadMark sOffset="0" type="solid"/></lane>
<lane id="-3" type="shoulder"><width sOffset="0" a="1" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes>"""


def written(folder: Path, *geometries: str, lanes: str = LANES, length: float = 40.0) -> Path:
    path = folder / "road.xodr"
    path.write_text(
        f'<OpenDRIVE><header revMajor="1" revMinor="7"/><road id="7" length="{length}" junction="-1">'
        f"<planView>{''.join(geometries)}</planView>{lanes}</road></OpenDRIVE>",
        encoding="utf-8",
    )
    return path


def geometry(
    kind: str, s: float = 0.0, length: float = 40.0, x: float = 0.0, y: float = 0.0, hdg: float = 0.0
) -> str:
    return f'<geometry s="{s}" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{kind}</geometry>'


def outline(path: Path) -> shapely.Geometry:
    """Return the driveable area of a map."""
    return shapely.union_all(read_map(path)._shapes[0])


def test_lanes_and_marked_lines(tmp_path: Path) -> None:
    path = written(tmp_path, geometry("<line/>"))
    vector_map = read_map(path)
    assert vector_map.counts == {"driveable_area": 4, "road_dividers": 1, "lane_dividers": 1}
    area = outline(path)
    assert area.bounds == pytest.approx((0, -3.5 - 4 - 1, 40, 3))
    assert area.area == pytest.approx(40 * (3 + 3.5 + 2 + 1))
    [road], [lane] = vector_map._shapes[1], vector_map._shapes[2]
    assert road.bounds == pytest.approx((0, 0, 40, 0))
    assert lane.bounds == pytest.approx((10, -3.5, 40, -3.5))  # unmarked before s = 10 m


def test_borders_and_offsets(tmp_path: Path) -> None:
    lanes = LANES.replace('laneOffset s="0" a="0"', 'laneOffset s="0" a="1"')
    lanes = lanes.replace('<width sOffset="0" a="3"', '<border sOffset="0" a="3"')
    assert outline(written(tmp_path, geometry("<line/>"), lanes=lanes)).bounds == pytest.approx(
        (0, -7.5, 40, 4)
    )


@pytest.mark.parametrize(
    ("kind", "end"),
    [
        ("<line/>", (40.0, 0.0)),
        ('<arc curvature="0.05"/>', (20 * np.sin(2.0), 20 * (1 - np.cos(2.0)))),
        ('<arc curvature="-0.05"/>', (20 * np.sin(2.0), -20 * (1 - np.cos(2.0)))),
        # Curvature 0 to 1/20 m over 40 m turns by 1 rad. Fresnel integrals by their series
        ('<spiral curvStart="0" curvEnd="0.05"/>', (40 * 0.9045242, 40 * 0.3102683)),
        ('<spiral curvStart="0.05" curvEnd="0.05"/>', (20 * np.sin(2.0), 20 * (1 - np.cos(2.0)))),
        ('<poly3 a="0" b="0" c="0" d="0"/>', (40.0, 0.0)),
        ('<paramPoly3 aU="0" bU="40" cU="0" dU="0" aV="0" bV="0" cV="10" dV="0"/>', (40.0, 10.0)),
        (
            '<paramPoly3 pRange="arcLength" aU="0" bU="1" cU="0" dU="0" aV="0" bV="0" cV="0.005" dV="0"/>',
            (40.0, 8.0),
        ),
    ],
)
def test_reference_lines(tmp_path: Path, kind: str, end: tuple[float, float]) -> None:
    [road] = read_map(written(tmp_path, geometry(kind)))._shapes[1]
    assert road.coords[0] == pytest.approx((0, 0))
    assert road.coords[-1] == pytest.approx(end, abs=1e-5)


def test_poly3_goes_by_arc_length(tmp_path: Path) -> None:
    [road] = read_map(written(tmp_path, geometry('<poly3 a="0" b="0" c="0.02" d="0"/>')))._shapes[1]
    assert road.length == pytest.approx(40.0, abs=0.01)
    x, y = road.coords[-1]
    assert y == pytest.approx(0.02 * x**2)


def test_geometries_are_placed_one_after_the_other(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        geometry("<line/>", length=10.0, x=5.0, y=5.0, hdg=np.pi / 2),
        geometry('<arc curvature="0.1"/>', s=10.0, length=30.0, x=5.0, y=15.0, hdg=np.pi / 2),
    )
    [road] = read_map(path)._shapes[1]
    assert road.coords[0] == pytest.approx((5, 5))
    assert road.length == pytest.approx(40.0, rel=1e-3)
    assert road.coords[-1] == pytest.approx((5 - 10 * (1 - np.cos(3)), 15 + 10 * np.sin(3)))


@pytest.mark.parametrize(
    ("geometries", "message"),
    [
        (geometry("<circle/>"), "road 7 of road.xodr is malformed.*neither line, arc"),
        (geometry("<arc/>"), "road 7 of road.xodr is malformed.*curvature"),
        (geometry('<arc curvature="x"/>'), "road 7 of road.xodr is malformed.*could not convert"),
        ("", "road.xodr has no driveable area"),
    ],
)
def test_roads_that_cannot_be_read_are_named(tmp_path: Path, geometries: str, message: str) -> None:
    with pytest.raises(MapError, match=message):
        read_map(written(tmp_path, geometries))


@pytest.mark.parametrize(
    ("name", "square_meters"),
    [
        # The areas are those of pyxodr-omega-prime 0.1.5 at a resolution of 0.1 m
        ("curve_r100.xodr", 4648),
        ("e6mini.xodr", 40711),
        ("fabriksgatan.xodr", 3885),
        ("multi_intersections.xodr", 21986),
    ],
)
def test_foreign_maps_have_the_area_that_another_reader_finds(name: str, square_meters: float) -> None:
    area = shapely.union_all(shapely.make_valid(opendrive.read(foreign(name))._shapes[0])).area
    assert area == pytest.approx(square_meters, rel=1e-3)
