"""Argoverse 2 vector maps."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from cab_forecast.maps import read_map
from tests.cab_forecast.maps.samples import foreign


def segment(y: float, left: str, right: str, *, neighbors: tuple[int | None, int | None]) -> dict[str, Any]:
    """Return a lane of 50 m along x, 3 m wide."""

    def boundary(at: float) -> list[dict[str, float]]:
        return [{"x": x, "y": at, "z": 0.0} for x in (0.0, 50.0)]

    return {
        "left_lane_boundary": boundary(y + 1.5),
        "right_lane_boundary": boundary(y - 1.5),
        "left_lane_mark_type": left,
        "right_lane_mark_type": right,
        "left_neighbor_id": neighbors[0],
        "right_neighbor_id": neighbors[1],
    }


def test_markings_become_dividers(tmp_path: Path) -> None:
    content = {
        "pedestrian_crossings": {},
        "drivable_areas": {
            "1": {
                "id": 1,
                "area_boundary": [{"x": x, "y": y, "z": 0} for x, y in ((0, 0), (50, 0), (50, 9), (0, 9))],
            }
        },
        "lane_segments": {
            "1": segment(1.5, "DASHED_WHITE", "SOLID_WHITE", neighbors=(2, None)),
            "2": segment(4.5, "DOUBLE_SOLID_YELLOW", "NONE", neighbors=(3, 1)),
            "3": segment(7.5, "UNKNOWN", "SOLID_DASH_YELLOW", neighbors=(None, 2)),
        },
    }
    path = tmp_path / "log_map_archive_x.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    vector_map = read_map(path)
    assert vector_map.counts == {"driveable_area": 1, "road_dividers": 2, "lane_dividers": 1}
    _, roads, lanes = vector_map.layers((10.0, 0.0), 30, 30, 3.0)
    assert np.flatnonzero(lanes[5]).tolist() == [8, 9]  # y = 3 m, ± 1/3 m
    assert np.flatnonzero(roads[5]).tolist() == [17, 18]


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("log_map_archive_0a1e6f0a-1817-4a98-b02e-db8c9327d151.json", (2, 24, 10)),
        ("log_map_archive_3b3570b4-7b0b-3268-a571-b0889dbf40b6____MIA_city_47894.json", (5, 50, 73)),
    ],
)
def test_a_foreign_map(name: str, counts: tuple[int, int, int]) -> None:
    path = foreign(name)
    vector_map = read_map(path)
    assert tuple(vector_map.counts.values()) == counts
    content = json.loads(path.read_text(encoding="utf-8"))
    # The centre lines of its lanes lie on the driveable area
    lanes = [lane for lane in content["lane_segments"].values() if lane["lane_type"] == "VEHICLE"]
    area = shapely.union_all(
        [
            shapely.Polygon([(p["x"], p["y"]) for p in one["area_boundary"]])
            for one in content["drivable_areas"].values()
        ]
    )
    middle = [
        np.mean([(p["x"], p["y"]) for p in lane["left_lane_boundary"] + lane["right_lane_boundary"]], 0)
        for lane in lanes
    ]
    inside = [point for point in middle if area.contains(shapely.Point(point))]
    assert len(inside) > 0.8 * len(middle)
    for point in inside:
        raster = vector_map.layers(point, 1, 1)
        assert raster[0, 0, 0]
