"""nuScenes map expansion."""

import json
from pathlib import Path

import numpy as np

from cab_forecast.maps import read_map


def test_the_layers_of_a_map_expansion(tmp_path: Path) -> None:
    """A driveable area with a hole, a lane beside it, and dividers."""
    places = {
        "a": (0, 0), "b": (30, 0), "c": (30, 20), "d": (0, 20),
        "h1": (10, 5), "h2": (20, 5), "h3": (20, 15), "h4": (10, 15),
        "l1": (30, 0), "l2": (40, 0), "l3": (40, 4), "l4": (30, 4),
    }  # fmt: skip
    content = {
        "node": [{"token": token, "x": x, "y": y} for token, (x, y) in places.items()],
        "polygon": [
            {
                "token": "area",
                "exterior_node_tokens": ["a", "b", "c", "d"],
                "holes": [{"node_tokens": ["h1", "h2", "h3", "h4"]}, {"node_tokens": []}],
            },
            {"token": "lane", "exterior_node_tokens": ["l1", "l2", "l3", "l4"], "holes": []},
        ],
        "line": [{"token": "line", "node_tokens": ["d", "c"]}, {"token": "other", "node_tokens": ["a", "b"]}],
        "drivable_area": [{"polygon_tokens": ["area"]}],
        "road_segment": [],
        "lane": [{"polygon_token": "lane"}],
        "road_divider": [{"line_token": "line"}],
        "lane_divider": [{"line_token": "other"}],
        "walkway": [{"polygon_token": "missing"}],
    }
    path = tmp_path / "town.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    vector_map = read_map(path)
    assert vector_map.counts == {"driveable_area": 2, "road_dividers": 1, "lane_dividers": 1}
    area, roads, lanes = vector_map.layers((0.5, 0.5), 40, 20, 1.0)
    expected = np.zeros((40, 20), dtype=bool)
    expected[:30] = True
    expected[10:20, 5:15] = False
    expected[30:, :4] = True
    np.testing.assert_array_equal(area, expected)
    assert np.flatnonzero(roads[3]).tolist() == [19]
    assert np.flatnonzero(lanes[3]).tolist() == [0]
