"""Bounds of the contract's fields that hold on every server, whatever its settings.

The comments of the .proto files give them in words. Nothing is imported here, so that services and clients
share one definition.
"""

MAX_ID_LENGTH = 128
"""Characters of an agent's or a scene's id."""
MAX_PRIORITY = 7
"""Highest priority of a call."""
MAX_DRAWS = 32
"""Most donors that an explanation draws for an agent."""
MAX_PERMUTATIONS = 256
"""Most orders of neighbours that an explanation draws for an agent."""
STEP_SECONDS = 0.5
"""Seconds between the steps of a forecast."""
PATCH_PIXELS = 100
"""Rows and columns of an agent's own map patches, near and far."""

_MAX_TIME = 1e10
_MAX_POSITION = 1e7

FIELD_BOUNDS: dict[str, tuple[float, float]] = {
    "PredictRequest.time": (-_MAX_TIME, _MAX_TIME),
    "ExplainRequest.time": (-_MAX_TIME, _MAX_TIME),
    "AgentState.time": (-_MAX_TIME, _MAX_TIME),
    "AgentState.x": (-_MAX_POSITION, _MAX_POSITION),
    "AgentState.y": (-_MAX_POSITION, _MAX_POSITION),
    "AgentState.heading": (-1e4, 1e4),
    "AgentState.velocity_x": (-150.0, 150.0),
    "AgentState.velocity_y": (-150.0, 150.0),
    "AgentState.acceleration_x": (-100.0, 100.0),
    "AgentState.acceleration_y": (-100.0, 100.0),
    "AgentState.heading_rate": (-20.0, 20.0),
    "SceneRaster.origin_x": (-_MAX_POSITION, _MAX_POSITION),
    "SceneRaster.origin_y": (-_MAX_POSITION, _MAX_POSITION),
    "SceneRaster.pixels_per_meter": (0.1, 100.0),
}
"""Lowest and highest value of each number, by "Message.field"; SI units, rad, s since the epoch."""
