"""A nuScenes data set of one scene (scene-0061, mini_train), in the exact schema of v1.0 with map 1.3.

A straight road 12 m wide along x = 300 … 500 at y = 700, with a divider in its middle and one lane divider.
The ego vehicle drives east at 10 m/s; a car follows and another is parked; a pedestrian crosses.
"""

import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image

SCENE, LOCATION = "scene-0061", "singapore-onenorth"
SAMPLES = 20
CATEGORIES = {
    "car": "vehicle.car",
    "parked": "vehicle.truck",
    "walker": "human.pedestrian.adult",
    "bicycle": "vehicle.bicycle",
    "stroller": "human.pedestrian.stroller",
    "cone": "movable_object.trafficcone",
}
POSES: dict[str, Callable[[float], tuple[float, float, float]]] = {
    "ego": lambda t: (400 + 10 * t, 697.0, 0.0),
    "car": lambda t: (380 + 10 * t, 697.0, 0.0),
    "parked": lambda _: (450.0, 692.0, math.pi),
    "walker": lambda t: (460.0, 690 + 1.5 * t, math.pi / 2),
    "bicycle": lambda t: (420 - 5 * t, 703.0, math.pi),
    "stroller": lambda t: (461.0, 690 + 1.5 * t, math.pi / 2),
    "cone": lambda _: (470.0, 694.0, 0.0),
}
"""x, y (m) and heading (rad) by time (s)."""
_START_US = 1_532_402_927_000_000


def token(name: str) -> str:
    """Return thirty-two hexadecimal digits."""
    return hashlib.md5(name.encode(), usedforsecurity=False).hexdigest()


def write_dataroot(root: Path) -> None:
    """Write all files."""
    tables = root / "v1.0-mini"
    tables.mkdir(parents=True)
    for name, rows in _tables().items():
        (tables / f"{name}.json").write_text(json.dumps(rows))
    maps = root / "maps"
    (maps / "expansion").mkdir(parents=True)
    (maps / "prediction").mkdir()
    Image.new("L", (10, 10)).save(maps / "mask.png")
    (maps / "expansion" / f"{LOCATION}.json").write_text(json.dumps(_map()))
    asked = [f"{token('car')}_{token(f'sample {frame}')}" for frame in (4, 5, 7)]
    (maps / "prediction" / "prediction_scenes.json").write_text(json.dumps({SCENE: asked}))


def _tables() -> dict[str, list[dict[str, Any]]]:
    def pose(name: str, frame: int) -> dict[str, list[float]]:
        x, y, heading = POSES[name](frame / 2)
        turn = [math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2)]
        return {"translation": [x, y, 0.5], "rotation": turn}

    def chain(what: str, frame: int) -> dict[str, str]:
        before = token(f"{what} {frame - 1}") if frame else ""
        after = token(f"{what} {frame + 1}") if frame + 1 < SAMPLES else ""
        return {"token": token(f"{what} {frame}"), "prev": before, "next": after}

    frames = range(SAMPLES)
    stamps = [_START_US + 500_000 * frame for frame in frames]
    still = {"translation": [0.0, 0.0, 1.8], "rotation": [1.0, 0.0, 0.0, 0.0]}
    annotation = {"visibility_token": "4", "attribute_tokens": [], "num_lidar_pts": 9, "num_radar_pts": 0}
    return {
        "attribute": [],
        "visibility": [{"token": "4", "level": "v80-100", "description": ""}],
        "category": [{"token": token(name), "name": name, "description": ""} for name in CATEGORIES.values()],
        "sensor": [{"token": token("lidar"), "channel": "LIDAR_TOP", "modality": "lidar"}],
        "calibrated_sensor": [
            {"token": token("mount"), "sensor_token": token("lidar"), "camera_intrinsic": [], **still}
        ],
        "log": [
            {
                "token": token("log"),
                "logfile": "n015-2018-07-24",
                "vehicle": "n015",
                "date_captured": "2018-07-24",
                "location": LOCATION,
            }
        ],
        "map": [
            {
                "token": token("map"),
                "log_tokens": [token("log")],
                "category": "semantic_prior",
                "filename": "maps/mask.png",
            }
        ],
        "scene": [
            {
                "token": token(SCENE),
                "log_token": token("log"),
                "nbr_samples": SAMPLES,
                "first_sample_token": token("sample 0"),
                "last_sample_token": token(f"sample {SAMPLES - 1}"),
                "name": SCENE,
                "description": "A straight road",
            }
        ],
        "sample": [
            {"timestamp": stamps[frame], "scene_token": token(SCENE), **chain("sample", frame)}
            for frame in frames
        ],
        "ego_pose": [
            {"token": token(f"pose {frame}"), "timestamp": stamps[frame], **pose("ego", frame)}
            for frame in frames
        ],
        "sample_data": [
            {
                "sample_token": token(f"sample {frame}"),
                "ego_pose_token": token(f"pose {frame}"),
                "calibrated_sensor_token": token("mount"),
                "timestamp": stamps[frame],
                "fileformat": "pcd",
                "is_key_frame": True,
                "height": 0,
                "width": 0,
                "filename": f"samples/LIDAR_TOP/{frame}.pcd.bin",
                **chain("scan", frame),
            }
            for frame in frames
        ],
        "instance": [
            {
                "token": token(name),
                "category_token": token(category),
                "nbr_annotations": SAMPLES,
                "first_annotation_token": token(f"{name} 0"),
                "last_annotation_token": token(f"{name} {SAMPLES - 1}"),
            }
            for name, category in CATEGORIES.items()
        ],
        "sample_annotation": [
            {
                "sample_token": token(f"sample {frame}"),
                "instance_token": token(name),
                "size": [1.9, 4.5, 1.6],
                **annotation,
                **pose(name, frame),
                **chain(name, frame),
            }
            for name in CATEGORIES
            for frame in frames
        ],
    }


def _map() -> dict[str, Any]:
    nodes: list[dict[str, Any]] = []

    def add(*points: tuple[float, float]) -> list[str]:
        start = len(nodes)
        nodes.extend({"token": f"n{start + k}", "x": x, "y": y} for k, (x, y) in enumerate(points))
        return [node["token"] for node in nodes[start:]]

    road = add((300, 694), (500, 694), (500, 706), (300, 706))
    island = add((400, 703), (410, 703), (410, 705), (400, 705))
    polygons = {"road": (road, []), "ring": (road, [{"node_tokens": island}])}
    lines = {"middle": add((300, 700), (500, 700)), "lane": add((300, 697), (380, 697), (500, 697))}
    empty = ("road_segment", "road_block", "ped_crossing", "walkway", "stop_line", "carpark_area", "lane")
    return {
        "version": "1.3",
        "canvas_edge": [1585.6, 2025.0],
        "node": nodes,
        "polygon": [
            {"token": name, "exterior_node_tokens": outer, "holes": holes}
            for name, (outer, holes) in polygons.items()
        ],
        "line": [{"token": name, "node_tokens": tokens} for name, tokens in lines.items()],
        **{name: [] for name in (*empty, "traffic_light", "lane_connector")},
        "drivable_area": [{"token": "area", "polygon_tokens": ["ring"]}],
        "road_divider": [{"token": "rd", "line_token": "middle", "road_segment_token": ""}],
        "lane_divider": [{"token": "ld", "line_token": "lane", "lane_divider_segments": []}],
        "arcline_path_3": {},
        "connectivity": {},
    }
