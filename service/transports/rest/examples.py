"""Requests that work as they stand, and an answer, for the documentation."""

from typing import Any

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import model_service_pb2 as models_pb
from model.scenes.scene import STEP_SECONDS
from service.transports.rest.codec import to_json

_NOW = 1_700_000_000.0
_FRAMES = 9
IDS = {"scene_id": "street-1", "agent_id": "car-1"}
"""The scene that one of the examples names, and an agent of it."""


def predict_examples() -> dict[str, dict[str, Any]]:
    """Examples of ``POST /v1/predict`` by name, as OpenAPI has them."""
    car = _agent(IDS["agent_id"], "AGENT_TYPE_VEHICLE", x=100.0, y=50.0, speed=8.0)
    walker = _agent("walker-1", "AGENT_TYPE_PEDESTRIAN", x=110.0, y=56.0, speed=1.4)
    parked = _agent("car-2", "AGENT_TYPE_VEHICLE", x=130.0, y=47.0, speed=0.0) | {"predict": False}
    return {
        "one_car": {
            "summary": "One car, the server's default model",
            "value": {"time": _NOW, "agents": [car]},
        },
        "street": {
            "summary": "A car and a pedestrian beside a parked car; at most three modes, merged, 3 s ahead",
            "value": {
                "scene_id": IDS["scene_id"],
                "time": _NOW,
                "agents": [car, walker, parked],
                "options": {"merge": True, "max_modes": 3, "horizon": 3.0},
            },
        },
        "samples": {
            "summary": "Ten sampled trajectories from a named model",
            "value": {
                "time": _NOW,
                "model": "kalman",
                "agents": [car],
                "options": {"max_modes": 1, "samples": 10, "seed": 7},
            },
        },
    }


def reset_examples() -> dict[str, dict[str, Any]]:
    """Examples of ``POST /v1/consistency/reset`` by name."""
    return {"street": {"summary": "Forget a scene", "value": {"scene_id": IDS["scene_id"]}}}


def events_example() -> dict[str, str]:
    """An event of ``GET /v1/consistency/events``."""
    instant = consistency_pb.InstantConsistency(
        agent_id=IDS["agent_id"],
        time=_NOW,
        model=models_pb.ModelReference(
            name="kalman", version="1.0.0", protocol=models_pb.INPUT_PROTOCOL_CAUSAL
        ),
        errors=[
            consistency_pb.AgeError(age=0.5, displacement_error=0.12, most_likely_was_nearest=True),
            consistency_pb.AgeError(age=1.0, displacement_error=0.31, most_likely_was_nearest=True),
        ],
    )
    return {
        "event": "message",
        "data": to_json(consistency_pb.WatchSceneResponse(instants=[instant])).decode(),
    }


def _agent(agent_id: str, kind: str, x: float, y: float, speed: float) -> dict[str, Any]:
    """An agent on its way along x, now at (x, y)."""
    states = []
    for age in range(_FRAMES - 1, -1, -1):
        seconds = age * STEP_SECONDS
        states.append({"time": _NOW - seconds, "x": round(x - speed * seconds, 3), "y": y, "heading": 0.0})
    return {"id": agent_id, "type": kind, "states": states}
