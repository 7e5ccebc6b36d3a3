"""Argoverse 2 vector maps: ``log_map_archive_*.json``, in metres of the city's frame.

The av2 package would bring 20 others along; the format is documented and small.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from cab_forecast.maps.vector_map import VectorMap


def read(content: Mapping[str, Any], source: str) -> VectorMap:
    """Read the JSON object of a map archive.

    Yellow markings separate opposite directions (road dividers), white ones between two lanes those of one
    direction (lane dividers). White markings at a road's edge are no dividers.

    Raises:
        MapError: it has no driveable area.
        KeyError: it is no such file.
    """
    segments = list(content["lane_segments"].values())
    areas = [area["area_boundary"] for area in content["drivable_areas"].values()]
    return VectorMap(
        {
            "driveable_area": [_vertices(area) for area in areas],
            "road_dividers": _markings(segments, "YELLOW", between_lanes=False),
            "lane_dividers": _markings(segments, "WHITE", between_lanes=True),
        },
        source=source,
    )


def _vertices(points: Iterable[Mapping[str, float]]) -> list[tuple[float, float]]:
    return [(point["x"], point["y"]) for point in points]


def _markings(
    segments: Iterable[Mapping[str, Any]], color: str, *, between_lanes: bool
) -> Iterator[list[tuple[float, float]]]:
    """Yield the marked boundaries of lanes in a color; a boundary of two lanes comes twice."""
    for segment in segments:
        for side in ("left", "right"):
            if between_lanes and segment[f"{side}_neighbor_id"] is None:
                continue
            if color in segment[f"{side}_lane_mark_type"]:
                yield _vertices(segment[f"{side}_lane_boundary"])
