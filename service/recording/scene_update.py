"""Agents and forecasts of a call as a Foxglove scene update."""

import math
import time
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.TextPrimitive_pb2 import TextPrimitive
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.duration_pb2 import Duration

from cab.forecast.v1 import model_service_pb2 as models_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Floats
from service.recording.call import AnsweredCall, recalled_states
from service.recording.frames import GROUND, newest_state, pose, timestamp

LIFETIME_SECONDS = 1
"""Seconds after which an agent disappears if no call brings it again."""
MIN_WEIGHT = 0.05
"""Min probability of a mode that is drawn; the most likely one always is."""
MAX_MODES = 5
"""Max number of modes of an agent that are drawn."""
_ELLIPSE_MODES = 2
_ELLIPSE_STEPS = (3, 7, 11)
"""Steps of 0.5 s at which ellipses are drawn: after 2, 4 and 6 s."""
_ELLIPSE_SCALE = 2.0 * math.sqrt(-2.0 * math.log(0.1))
"""Diameters of an ellipse that holds 90 % of a Gaussian in the plane, per standard deviation."""
_HISTORY_STATES = 50
"""Max number of observations of an agent that are drawn, the newest ones."""
_MIN_STEP = 0.2
"""m; shorter motion tells no heading."""
_PAUSE_SECONDS = 0.0001
"""Pause after each agent, which takes some 0.2 ms: without it the interpreter lock would be held for 5 ms."""
_HISTORY_HEIGHT, _FORECAST_HEIGHT, _ELLIPSE_HEIGHT = 0.1, 0.2, 0.02  # m
_HISTORY_WIDTH, _LEAST_WIDTH, _WIDTH_PER_WEIGHT = 0.15, 0.08, 0.5  # m
_FONT = 0.8  # m

_SIZES = {
    models_pb.AGENT_TYPE_VEHICLE: (4.6, 1.9, 1.6),
    models_pb.AGENT_TYPE_PEDESTRIAN: (0.7, 0.7, 1.75),
    models_pb.AGENT_TYPE_CYCLIST: (1.8, 0.7, 1.7),
}
"""Nominal length, width and height, m: requests have no sizes of agents."""
_TYPE_NAMES = {
    number: name.removeprefix("AGENT_TYPE_").lower() for name, number in models_pb.AgentType.items()
}
_STATUS_NAMES = {number: name.removeprefix("FORECAST_STATUS_") for name, number in pb.ForecastStatus.items()}
_OTHER_SIZE = (1.0, 1.0, 1.0)
_COLORS = {
    models_pb.AGENT_TYPE_VEHICLE: (0.25, 0.55, 0.95),
    models_pb.AGENT_TYPE_PEDESTRIAN: (0.92, 0.32, 0.40),
    models_pb.AGENT_TYPE_CYCLIST: (0.25, 0.75, 0.42),
}
_OTHER_COLOR = (0.65, 0.45, 0.85)
_INVALID_COLOR = (0.55, 0.55, 0.55)


def scene_update(call: AnsweredCall) -> SceneUpdate:
    """Return an entity for each agent, with its history and forecast.

    Points are relative to their agent, because viewers draw in single precision. Between the agents other
    threads get the interpreter: calls are more urgent.
    """
    recalled = {agent_id: recalled_states(history) for agent_id, history in call.histories.items() if history}
    forecasts = {forecast.agent_id: forecast for forecast in call.response.forecasts}
    entities = []
    for agent in call.request.agents:
        now = newest_state(agent)
        if now is None:
            continue
        states = recalled.get(agent.id) or agent.states
        entity = _agent(agent, now, states, forecasts.get(agent.id), call.response.steps)
        entity.id = f"{call.request.scene_id}/{agent.id}"
        entity.timestamp.CopyFrom(timestamp(call))
        entities.append(entity)
        time.sleep(_PAUSE_SECONDS)
    return SceneUpdate(entities=entities)


def _agent(
    agent: pb.Agent,
    now: pb.AgentState,
    states: Sequence[pb.AgentState],
    forecast: pb.AgentForecast | None,
    steps: int,
) -> SceneEntity:
    """Return the entity of an agent.

    Args:
        agent: the agent.
        now: its newest state.
        states: its observations, ascending by time.
        forecast: its forecast; None for a neighbour.
        steps: the number of steps of a forecast.
    """
    invalid = forecast is not None and forecast.status == pb.FORECAST_STATUS_INVALID
    rgb = _INVALID_COLOR if invalid else _COLORS.get(agent.type, _OTHER_COLOR)
    length, width, height = _SIZES.get(agent.type, _OTHER_SIZE)
    entity = SceneEntity(
        frame_id=GROUND,
        lifetime=Duration(seconds=LIFETIME_SECONDS),
        metadata=[KeyValuePair(key=key, value=value) for key, value in _metadata(agent, forecast).items()],
        cubes=[
            CubePrimitive(
                pose=pose(now.x, now.y, 0.5 * height, _yaw(states)),
                size=Vector3(x=length, y=width, z=height),
                color=_color(rgb, 0.9 if forecast is not None else 0.5),
            )
        ],
        texts=[
            TextPrimitive(
                pose=pose(now.x, now.y, height + _FONT),
                billboard=True,
                font_size=_FONT,
                color=_color((1.0, 1.0, 1.0), 1.0),
                text=agent.id,
            )
        ],
    )
    base = pose(now.x, now.y, 0.0)
    history = [(state.x - now.x, state.y - now.y) for state in states[-_HISTORY_STATES:]]
    if len(history) > 1:
        entity.lines.append(_line(base, history, _HISTORY_HEIGHT, _HISTORY_WIDTH, _color(rgb, 0.5)))
    if forecast is not None and forecast.weights and steps:
        _add_forecast(entity, forecast, base, steps, rgb)
    return entity


def _add_forecast(
    entity: SceneEntity, forecast: pb.AgentForecast, base: Pose, steps: int, rgb: tuple[float, float, float]
) -> None:
    """Add the most likely modes as lines, the wider the likelier, and ellipses of the first ones."""
    weights: Floats = np.array(list(forecast.weights))
    modes = np.argsort(-weights, kind="stable")[:MAX_MODES]
    modes = modes[weights[modes] >= min(MIN_WEIGHT, weights[modes[0]])]
    here = np.array([base.position.x, base.position.y])
    means = np.array(list(forecast.means)).reshape(-1, steps, 2)[modes] - here
    for weight, path in zip(weights[modes].tolist(), means.tolist(), strict=True):
        color = _color(rgb, 0.3 + 0.7 * weight)
        width = _LEAST_WIDTH + _WIDTH_PER_WEIGHT * weight
        entity.lines.append(_line(base, [(0.0, 0.0), *path], _FORECAST_HEIGHT, width, color))
    drawn = [step for step in _ELLIPSE_STEPS if step < steps]
    triangles = np.array(list(forecast.covariances)).reshape(-1, steps, 3)[modes[:_ELLIPSE_MODES]][:, drawn]
    variances, axes = np.linalg.eigh(triangles[..., [0, 1, 1, 2]].reshape(-1, 2, 2))
    diameters = _ELLIPSE_SCALE * np.sqrt(np.maximum(variances, 0.0))
    yaws = np.arctan2(axes[:, 1, 1], axes[:, 0, 1])  # of the longer axis
    middles = (means[:_ELLIPSE_MODES, drawn] + here).reshape(-1, 2)
    for middle, diameter, yaw in zip(middles.tolist(), diameters.tolist(), yaws.tolist(), strict=True):
        entity.cylinders.append(
            CylinderPrimitive(
                pose=pose(middle[0], middle[1], _ELLIPSE_HEIGHT, yaw),
                size=Vector3(x=diameter[1], y=diameter[0], z=_ELLIPSE_HEIGHT),
                bottom_scale=1.0,
                top_scale=1.0,
                color=_color(rgb, 0.15),
            )
        )


def _metadata(agent: pb.Agent, forecast: pb.AgentForecast | None) -> Mapping[str, str]:
    """Return what the viewer shows of an agent that is selected."""
    values = {"type": _TYPE_NAMES.get(agent.type, str(agent.type))}
    if forecast is not None:
        values["status"] = _STATUS_NAMES.get(forecast.status, str(forecast.status))
        values["detail"] = forecast.detail
        values["model"] = f"{forecast.model.name}@{forecast.model.version}"
        values["weights"] = ", ".join(f"{weight:.3f}" for weight in sorted(forecast.weights, reverse=True))
    return values


def _yaw(states: Sequence[pb.AgentState]) -> float:
    """Return the newest heading, rad: as given, else of the motion, else 0."""
    now = states[-1]
    if now.HasField("heading"):
        return now.heading
    for state in reversed(states):
        if math.hypot(now.x - state.x, now.y - state.y) >= _MIN_STEP:
            return math.atan2(now.y - state.y, now.x - state.x)
    return math.atan2(now.velocity_y, now.velocity_x)


def _line(
    base: Pose, points: Iterable[tuple[float, float]], height: float, width: float, color: Color
) -> LinePrimitive:
    """Return a line through points relative to the base."""
    return LinePrimitive(
        type=LinePrimitive.LINE_STRIP,
        pose=base,
        thickness=width,
        points=[Point3(x=x, y=y, z=height) for x, y in points],
        color=color,
    )


def _color(rgb: tuple[float, float, float], alpha: float) -> Color:
    red, green, blue = rgb
    return Color(r=red, g=green, b=blue, a=alpha)
