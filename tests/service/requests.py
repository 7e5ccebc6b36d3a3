"""Builders of requests."""

import io

import numpy as np
from PIL import Image

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Bytes

NOW = 1_700_000_000.0
VEHICLE = models_pb.AGENT_TYPE_VEHICLE
PEDESTRIAN = models_pb.AGENT_TYPE_PEDESTRIAN
CYCLIST = models_pb.AGENT_TYPE_CYCLIST


def add_agent(
    request: pb.PredictRequest,
    agent_id: str = "a",
    kind: models_pb.AgentType.ValueType = VEHICLE,
    *,
    x: float = 0.0,
    y: float = 0.0,
    speed: float = 5.0,
    frames: int = 6,
) -> pb.Agent:
    """Add an agent that drives along x and is at (x, y) now."""
    agent = request.agents.add(id=agent_id, type=kind)
    for age in range(frames - 1, -1, -1):
        agent.states.add(time=request.time - 0.5 * age, x=x - 0.5 * age * speed, y=y, heading=0.0)
    return agent


def make_request(agents: int = 1, model: str = "", **options: object) -> pb.PredictRequest:
    """Return a request with vehicles a0, a1, … side by side."""
    request = pb.PredictRequest(time=NOW, model=model, options=pb.PredictOptions(**options))  # type: ignore[arg-type]
    for index in range(agents):
        add_agent(request, f"a{index}", y=4.0 * index)
    return request


def pack(layers: Bytes) -> bytes:
    """Return layers [3, rows, columns] as packed bits."""
    return np.packbits(layers.reshape(-1)).tobytes()


def png(layers: Bytes, mode: str = "RGB", kind: str = "PNG") -> bytes:
    """Return layers [3, rows, columns] as an image file."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(layers.transpose(1, 2, 0) * np.uint8(255))).convert(mode).save(
        buffer, kind
    )
    return buffer.getvalue()
