"""nuScenes map expansion: one JSON file a location, in metres.

The driveable area is the union of ``drivable_area``, ``road_segment`` and ``lane``, the dividers are
``road_divider`` and ``lane_divider``, as in the rasters that the bundled networks were trained on.
"""

from collections.abc import Mapping
from typing import Any

import shapely

from cab_forecast.maps.vector_map import VectorMap


def read(content: Mapping[str, Any], source: str) -> VectorMap:
    """Read the JSON object of a map expansion file (version 1.0 or later).

    Raises:
        MapError: it has no driveable area.
        KeyError: it is no such file.
    """
    nodes = {node["token"]: (node["x"], node["y"]) for node in content["node"]}
    polygons = {polygon["token"]: polygon for polygon in content["polygon"]}
    lines = {line["token"]: line for line in content["line"]}

    def area(token: str) -> Any:
        polygon = polygons[token]
        outer = [nodes[node] for node in polygon["exterior_node_tokens"]]
        holes = [[nodes[node] for node in hole["node_tokens"]] for hole in polygon["holes"]]
        return shapely.Polygon(outer, [hole for hole in holes if len(hole) > 2])

    def divider(record: Mapping[str, Any]) -> Any:
        return shapely.LineString([nodes[node] for node in lines[record["line_token"]]["node_tokens"]])

    tokens = [token for record in content["drivable_area"] for token in record["polygon_tokens"]]
    tokens += [record["polygon_token"] for name in ("road_segment", "lane") for record in content[name]]
    return VectorMap(
        {
            "driveable_area": [area(token) for token in tokens],
            "road_dividers": [divider(record) for record in content["road_divider"]],
            "lane_dividers": [divider(record) for record in content["lane_divider"]],
        },
        source=source,
    )
