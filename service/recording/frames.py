"""Coordinate frames and times of the Foxglove messages of a call."""

import math

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from cab.forecast.v1 import prediction_service_pb2 as pb
from service.recording.call import AnsweredCall

GROUND = "map"
"""Frame of all positions: the ground frame of the requests. Foxglove shows this frame by default."""
AGENTS = "agents"
"""Frame at the middle of the agents of a call; the scene's name follows. Ground frames can have their origin
many kilometres away."""


def timestamp(call: AnsweredCall) -> Timestamp:
    """Return the time of the answer."""
    time = Timestamp()
    time.FromNanoseconds(call.time_ns)
    return time


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> Pose:
    """Return a pose in the ground plane.

    Args:
        x, y, z: position, m.
        yaw: heading, rad, counter-clockwise.
    """
    rotation = Quaternion(z=math.sin(0.5 * yaw), w=math.cos(0.5 * yaw))
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=rotation)


def agents_frame(call: AnsweredCall) -> FrameTransform | None:
    """Return the transform from the frame of the call's agents to the ground frame; None without agents."""
    newest = [state for agent in call.request.agents if (state := newest_state(agent)) is not None]
    if not newest:
        return None
    scene_id = call.request.scene_id
    return FrameTransform(
        timestamp=timestamp(call),
        parent_frame_id=GROUND,
        child_frame_id=f"{AGENTS}/{scene_id}" if scene_id else AGENTS,
        translation=Vector3(
            x=sum(state.x for state in newest) / len(newest), y=sum(state.y for state in newest) / len(newest)
        ),
        rotation=Quaternion(w=1.0),
    )


def newest_state(agent: pb.Agent) -> pb.AgentState | None:
    """Return the newest state of an agent; None if there is none, or its position is not finite."""
    if not agent.states:
        return None
    state = agent.states[-1]
    return state if math.isfinite(state.x) and math.isfinite(state.y) else None
