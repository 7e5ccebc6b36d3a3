"""Autoware's perception messages to and from the contract, without ROS: dicts in, dicts out.

Messages are dicts as ``rosidl_runtime_py.message_to_ordereddict`` makes them. Requests and responses are the
contract's JSON. docs/autoware.md has the table of fields. Nothing but the standard library is needed:

    python3 examples/python/autoware.py examples/python/tracked_objects.json

sends the messages in the file, one call each, and prints the last answer as PredictedObjects.
"""

import argparse
import json
import math
import sys
import urllib.error
import urllib.request
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Fields = dict[str, Any]

TYPES = {
    0: "AGENT_TYPE_UNKNOWN",
    1: "AGENT_TYPE_VEHICLE",  # CAR
    2: "AGENT_TYPE_VEHICLE",  # TRUCK
    3: "AGENT_TYPE_VEHICLE",  # BUS
    4: "AGENT_TYPE_VEHICLE",  # TRAILER
    5: "AGENT_TYPE_CYCLIST",  # MOTORCYCLE
    6: "AGENT_TYPE_CYCLIST",  # BICYCLE
    7: "AGENT_TYPE_PEDESTRIAN",
}
"""Agent type of each label of ObjectClassification; those that are not here are unknown."""
ORIENTATION_UNAVAILABLE, SIGN_UNKNOWN, ORIENTATION_AVAILABLE = 0, 1, 2
"""Values of TrackedObjectKinematics.orientation_availability. PredictedObjects have full orientations."""
MAX_PATHS = 100
"""Bound of predicted_paths in autoware_auto_perception_msgs."""
_STANDS = 0.05
"""Way within a step, m, below which a pose keeps the direction of the one before."""


@dataclass(frozen=True)
class Path2D:
    """One predicted path: a possible future, step by step."""

    confidence: float
    step: float
    """s between the positions."""
    positions: list[tuple[float, float]]
    """m; the first one is where the object is at the message's time."""


def predict_request(message: Fields, scene_id: str, frame: str = "map") -> Fields:
    """Return the Predict request for the objects of a TrackedObjects or PredictedObjects message.

    A message holds one observation of each object; the earlier ones come from the server's track memory, so
    send every message.

    Args:
        message: the message.
        scene_id: names the track memory; the frame must stay the same as long as the name does.
        frame: frame that is fixed to the ground.

    Raises:
        ValueError: the message is in another frame.
    """
    if message["header"]["frame_id"] != frame:
        raise ValueError(f'positions must be in the frame "{frame}", not "{message["header"]["frame_id"]}"')
    time = from_stamp(message["header"]["stamp"])
    return {
        "scene_id": scene_id,
        "time": time,
        "agents": [
            {"id": agent_id(one), "type": agent_type(one), "states": [state(one, time)]}
            for one in message["objects"]
        ],
        "options": {"merge": True, "history": "HISTORY_SOURCE_MEMORY"},
    }


def predicted_objects(response: Fields, message: Fields) -> Fields:
    """Return PredictedObjects: the objects of a message with the forecasts of the response to its request.

    An object without a forecast (status INVALID) stays in the message, with no predicted path.

    Raises:
        ValueError: an object has more paths than a message can hold.
    """
    forecasts = {one["agent_id"]: one for one in response["forecasts"]}
    objects = []
    for one in message["objects"]:
        pose, twist, acceleration = (
            _kinematics(one, f"{name}_with_covariance") for name in ("pose", "twist", "acceleration")
        )
        paths = predicted_paths(forecasts.get(agent_id(one), {}), response, one)
        if len(paths) > MAX_PATHS:
            raise ValueError(f"object {agent_id(one)} has {len(paths)} paths: ask for merged modes")
        objects.append(
            {
                "object_id": one["object_id"],
                "existence_probability": one["existence_probability"],
                "classification": one["classification"],
                "kinematics": {
                    "initial_pose_with_covariance": pose,
                    "initial_twist_with_covariance": twist,
                    "initial_acceleration_with_covariance": acceleration,
                    "predicted_paths": paths,
                },
                "shape": one["shape"],
            }
        )
    return {"header": message["header"], "objects": objects}


def predicted_paths(forecast: Fields, response: Fields, one: Fields) -> list[Fields]:
    """Return a PredictedPath for each mode of a forecast, the most likely one first.

    As in Autoware, a path begins with the present pose. The poses have the object's height, and the direction
    in which the path goes; a vehicle that reverses keeps its front.
    """
    pose = _kinematics(one, "pose_with_covariance")["pose"]
    position = pose["position"]
    steps, reverses = response.get("steps", 0), agent_type(one) == "AGENT_TYPE_VEHICLE"
    weights, means = forecast.get("weights", []), forecast.get("means", [])
    paths = []
    for mode in sorted(range(len(weights)), key=lambda number: -weights[number]):
        first = mode * steps * 2
        points = list(
            zip(means[first : first + 2 * steps : 2], means[first + 1 : first + 2 * steps : 2], strict=True)
        )
        poses, yaw, before = [pose], to_yaw(pose["orientation"]), (position["x"], position["y"])
        for point in points:
            way = (point[0] - before[0], point[1] - before[1])
            if math.hypot(*way) >= _STANDS:
                yaw = _direction(way, yaw, reverses=reverses)
            poses.append(
                {
                    "position": {"x": point[0], "y": point[1], "z": position["z"]},
                    "orientation": to_quaternion(yaw),
                }
            )
            before = point
        paths.append({"path": poses, "time_step": to_duration(response["step"]), "confidence": weights[mode]})
    return paths


def paths(one: Fields) -> list[Path2D]:
    """Return the predicted paths of an object of PredictedObjects, whoever predicted them."""
    return [
        Path2D(
            path["confidence"],
            from_stamp(path["time_step"]),
            [(pose["position"]["x"], pose["position"]["y"]) for pose in path["path"]],
        )
        for path in one["kinematics"]["predicted_paths"]
    ]


def forecast(one: Fields) -> Fields:
    """Return the fields of AgentForecast that an object of PredictedObjects holds: weights and means.

    Weights are the confidences, scaled so that they sum to 1. Messages have no covariances of paths.

    Raises:
        ValueError: paths differ in length or step, or all confidences are 0.
    """
    found = paths(one)
    if len({(path.step, len(path.positions)) for path in found}) > 1:
        raise ValueError(f"paths of object {agent_id(one)} differ in length or step")
    total = sum(path.confidence for path in found)
    if found and total <= 0:
        raise ValueError(f"all confidences of object {agent_id(one)} are 0")
    return {
        "agent_id": agent_id(one),
        "weights": [path.confidence / total for path in found],
        "means": [value for path in found for position in path.positions[1:] for value in position],
    }


def state(one: Fields, time: float) -> Fields:
    """Return the observation of an object at a time, s.

    Twists are in the object's frame, velocities in the ground frame. Without an orientation neither heading
    nor velocity is known; if its sign is unknown, the heading is not. Accelerations and turn rates are left
    out: where a tracker does not estimate them they are 0, which would be a measurement.
    """
    pose = _kinematics(one, "pose_with_covariance")["pose"]
    found = {"time": time, "x": pose["position"]["x"], "y": pose["position"]["y"]}
    availability = one["kinematics"].get("orientation_availability", ORIENTATION_AVAILABLE)
    if availability == ORIENTATION_UNAVAILABLE:
        return found
    yaw = to_yaw(pose["orientation"])
    linear = _kinematics(one, "twist_with_covariance")["twist"]["linear"]
    cos, sin = math.cos(yaw), math.sin(yaw)
    found["velocity_x"] = cos * linear["x"] - sin * linear["y"]
    found["velocity_y"] = sin * linear["x"] + cos * linear["y"]
    if availability != SIGN_UNKNOWN:
        found["heading"] = yaw
    return found


def agent_id(one: Fields) -> str:
    """Return the id of an object: its UUID as 32 hexadecimal digits."""
    return bytes(one["object_id"]["uuid"]).hex()


def object_id(agent: str) -> Fields:
    """Return the UUID of an id that ``agent_id`` made."""
    return {"uuid": list(bytes.fromhex(agent))}


def agent_type(one: Fields) -> str:
    """Return the type of an object: that of its most probable label."""
    labels = one["classification"]
    if not labels:
        return TYPES[0]
    return TYPES.get(max(labels, key=lambda label: label["probability"])["label"], TYPES[0])


def to_yaw(orientation: Fields) -> float:
    """Return the yaw of a quaternion, rad counter-clockwise from the x axis."""
    x, y, z, w = (orientation[axis] for axis in "xyzw")
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def to_quaternion(yaw: float) -> Fields:
    """Return the quaternion of a yaw, rad."""
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def from_stamp(stamp: Fields) -> float:
    """Return the seconds of a Time or Duration."""
    seconds: float = stamp["sec"] + stamp["nanosec"] * 1e-9
    return seconds


def to_duration(seconds: float) -> Fields:
    """Return a Duration of seconds, to the nanosecond."""
    whole, nanoseconds = divmod(round(seconds * 1e9), 1_000_000_000)
    return {"sec": whole, "nanosec": nanoseconds}


def _kinematics(one: Fields, name: str) -> Fields:
    """Return a field of the kinematics, which PredictedObjects call "initial"."""
    kinematics = one["kinematics"]
    found: Fields = kinematics[name] if name in kinematics else kinematics[f"initial_{name}"]
    return found


def _direction(way: tuple[float, float], before: float, *, reverses: bool) -> float:
    """Return the yaw of a way; of a vehicle that goes backwards the opposite of it."""
    yaw = math.atan2(way[1], way[0])
    return yaw + math.pi if reverses and math.cos(yaw - before) < 0 else yaw


def call(url: str, request: Fields) -> Fields:
    """Send a Predict request over REST, and return the response.

    Raises:
        urllib.error.HTTPError: the server refused it; the body is problem+json.
        urllib.error.URLError: the server cannot be reached.
    """
    body, headers = json.dumps(request).encode(), {"Content-Type": "application/json"}
    sending = urllib.request.Request(f"{url}/v1/predict", body, headers)  # noqa: S310 - the user's own URL
    with urllib.request.urlopen(sending, timeout=5) as answer:  # noqa: S310
        response: Fields = json.load(answer)
    return response


def main() -> int:
    """Forecast the messages of a file; print the last answer as PredictedObjects."""
    parser = argparse.ArgumentParser(description="Forecast Autoware's tracked objects.")
    parser.add_argument("file", type=Path, help="JSON list of TrackedObjects messages, oldest first")
    parser.add_argument("--url", default="http://127.0.0.1:8080", help="REST address of the server")
    parser.add_argument("--scene", default="autoware", help="name of the track memory")
    arguments = parser.parse_args()
    message: Fields = {}
    response: Fields = {"forecasts": []}
    try:
        for message in json.loads(arguments.file.read_text(encoding="utf-8")):
            response = call(arguments.url, predict_request(message, arguments.scene))
    except urllib.error.HTTPError as error:
        print(json.load(error)["detail"], file=sys.stderr)
        return 1
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 1
    for one in response["forecasts"]:
        print(one["agent_id"], one["status"], one.get("detail", ""), file=sys.stderr)
    print(json.dumps(predicted_objects(response, message), indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
