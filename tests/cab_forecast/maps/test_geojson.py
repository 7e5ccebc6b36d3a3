"""GeoJSON, and how files are told apart."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cab_forecast.maps import MapError, read_map

SQUARE = [[[0, 0], [60, 0], [60, 40], [0, 40], [0, 0]]]


def feature(layer: str | None, kind: str, coordinates: Any) -> dict[str, Any]:
    properties = None if layer is None else {"layer": layer}
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def written(folder: Path, *features: dict[str, Any], name: str = "town.geojson") -> Path:
    path = folder / name
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")
    return path


def test_layers_are_told_by_a_property(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        feature("drivable_area", "Polygon", SQUARE),
        feature("road_divider", "LineString", [[0, 20], [60, 20]]),
        feature("lane_dividers", "MultiLineString", [[[0, 10], [60, 10]], [[0, 30], [60, 30]]]),
        feature("building", "Polygon", SQUARE),
        feature(None, "Point", [1, 1]),
        {"type": "Feature", "properties": {"layer": "driveable_area"}, "geometry": None},
        name="town.json",  # told by its keys
    )
    vector_map = read_map(path)
    assert vector_map.counts == {"driveable_area": 1, "road_dividers": 1, "lane_dividers": 2}
    assert "left out 1 features whose layer is building" in vector_map.notes


def test_other_properties_and_values(tmp_path: Path) -> None:
    path = written(tmp_path, {**feature(None, "Polygon", SQUARE), "properties": {"class": 7}})
    with pytest.raises(
        MapError, match=r"property 'layer' should be driveable_area, drivable_area.*is nothing"
    ):
        read_map(path)
    with pytest.raises(MapError, match=r"property 'class' should be .*and is 7\..*--layer-property"):
        read_map(path, layer_property="class")
    read_map(path, layer_property="class", layer_values={"driveable_area": ["7", "8"]})
    with pytest.raises(MapError, match="there is no layer 'pavement'"):
        read_map(path, layer_property="class", layer_values={"pavement": ["7"]})


def test_degrees_need_an_origin(tmp_path: Path) -> None:
    # One minute of latitude is a nautical mile; at 60° north one of longitude is half of that
    ring = [
        [[10.0, 60.0], [10.0 + 1 / 60, 60.0], [10.0 + 1 / 60, 60 + 1 / 60], [10.0, 60 + 1 / 60], [10.0, 60.0]]
    ]
    path = written(tmp_path, feature("driveable_area", "Polygon", ring))
    with pytest.raises(MapError, match="look like degrees"):
        read_map(path)
    extent = read_map(path, origin=(60.0, 10.0)).extent
    # UTM is up to 0.04 % short, and turned against north by 0.9° here
    np.testing.assert_allclose(extent.high - extent.low, [930 + 30, 1857 + 15], rtol=0.01)
    with pytest.raises(MapError, match="latitude, then longitude"):
        read_map(path, origin=(10.0, 60.0))
    with pytest.raises(MapError, match="latitude \\(−80 … 84\\)"):
        read_map(path, origin=(100.0, 10.0))


def test_metres_take_no_origin(tmp_path: Path) -> None:
    path = written(tmp_path, feature("driveable_area", "Polygon", [[[0, 0], [600, 0], [600, 400], [0, 0]]]))
    with pytest.raises(MapError, match="if they are metres, leave the origin out"):
        read_map(path, origin=(60.0, 10.0))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.geojson", '{"type": "Polygon"}', "no GeoJSON FeatureCollection: its type is 'Polygon'"),
        ("a.json", '{"rows": 3}', "none of the keys drivable_areas, drivable_area, features"),
        ("a.json", "[1]", "its JSON is no object"),
        ("a.png", "\x89PNG", r"neither JSON \(.*\), nor named \.osm"),
        ("a.geojson", '{"type": "FeatureCollection"}', "no map of geojson: KeyError"),
        ("a.json", '{"drivable_area": []}', "no map of nuscenes: KeyError"),
        ("a.json", '{"drivable_areas": {}, "lane_segments": {}}', "a.json has no driveable area"),
        ("a.osm", "nothing", "no map of Lanelet2"),
        ("a.xodr", "nothing", "no map of OpenDRIVE"),
        ("a.xodr", "<osm/>", "no map of OpenDRIVE: its root is osm"),
        ("a.xodr", "<OpenDRIVE/>", "a.xodr has no driveable area"),
    ],
)
def test_files_that_are_no_maps_say_why(tmp_path: Path, name: str, content: str, message: str) -> None:
    if name.endswith(".osm"):
        pytest.importorskip("lanelet2")
    (tmp_path / name).write_text(content, encoding="utf-8")
    with pytest.raises(MapError, match=message):
        read_map(tmp_path / name)


@pytest.mark.parametrize(
    "geometry",
    [{"type": "Polygon", "coordinates": [[[0, 0], [1]]]}, {"type": "Polygon"}, {"type": "Blob"}, 7],
)
def test_malformed_geometries_are_named(tmp_path: Path, geometry: Any) -> None:
    path = written(
        tmp_path,
        feature("driveable_area", "Polygon", SQUARE),
        {"type": "Feature", "properties": {"layer": "driveable_area"}, "geometry": geometry},
    )
    with pytest.raises(MapError, match=r"features\[1\] of town\.geojson is malformed"):
        read_map(path)


def test_arguments_that_do_not_fit_the_format(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text('{"drivable_areas": {}, "lane_segments": {}}', encoding="utf-8")
    with pytest.raises(MapError, match="argoverse2, which is in metres: leave the origin out"):
        read_map(path, origin=(1.0, 2.0))
    with pytest.raises(MapError, match="only those in GeoJSON"):
        read_map(path, layer_property="class")
    with pytest.raises(MapError, match="formats of maps are nuscenes, argoverse2"):
        read_map(path, map_format="shapefile")  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError):
        read_map(tmp_path / "missing.json")
    for name in ("missing.osm", "missing.xodr"):
        if name.endswith(".osm"):
            pytest.importorskip("lanelet2")
        with pytest.raises(FileNotFoundError):
            read_map(tmp_path / name)
