"""Canary scene: a check that a model forecasts, before it forecasts for callers.

The check knows no expected numbers, so it holds for every model: it refuses what no sound model forecasts.
"""

from collections.abc import Sequence

import numpy as np
import torch

from model.arrays import Bytes
from model.forecaster import Forecaster
from model.mixture import TrajectoryMixture
from model.scenes.scene import STEP_SECONDS, AgentStates, AgentType, Raster, Scene
from service.predict.forward import finite, require_shapes

_SPEEDS = {AgentType.PEDESTRIAN: 1.4}
"""m/s of the agent that moves, by its type."""
_ELSE_SPEED = 10.0
_MAX_STANDING_M = 15.0
"""Meters that the likeliest trajectory of an agent that stands may lead; of bundled models at most 8.1."""
_MOVING = (1 / 3, 2.0)
"""Meters that the likeliest trajectory of an agent that moves may lead, as a share of those at constant
speed; of bundled models 0.93 to 1.04."""
_WEIGHT_TOLERANCE = 1e-3
_LANE_M = 8.0
"""Width of a lane."""
_DIVIDER_M = 0.4
"""Width of what divides two lanes."""
_MARGIN_M = 60.0
_PIXELS_PER_METER = 3.0
_PIXELS = 600


class CanaryError(Exception):
    """Error of a model that does not forecast the canary scene as a sound model does; the text says how."""


def check(forecaster: Forecaster) -> None:
    """Forecast an agent that stands and one that moves, on two lanes of a straight road.

    It checks for each agent type and context of the model: shapes, finite numbers, weights that sum to 1,
    covariances that are positive definite, and distances that are possible.

    Raises:
        CanaryError: a forecast is not sound, or the model raised an exception.
    """
    info = forecaster.info
    for kind in info.agent_types:
        speed = _SPEEDS.get(kind, _ELSE_SPEED)
        scene = straight_scene(kind, info.history_frames, [0.0, speed])
        for context in info.contexts:
            where = f"canary scene ({kind.value}, {context.value} context)"
            try:
                with torch.inference_mode():
                    mixture = forecaster(scene, np.arange(2), context)
                    require_shapes(info, mixture, 2, info.steps)
                    fault = _fault(mixture, speed * info.horizon)
            except Exception as error:
                raise CanaryError(f"{info.full_name} failed on the {where}: {error}") from error
            if fault is not None:
                raise CanaryError(f"{info.full_name} is refused by the {where}: {fault}")


def straight_scene(kind: AgentType, frames: int, speeds: Sequence[float]) -> Scene:
    """Return a scene of agents side by side that drive straight along x, each in a lane of its own.

    Args:
        kind: the type of all agents.
        frames: number of observed frames.
        speeds: the speed of each agent, m/s.
    """
    agents = len(speeds)
    age = STEP_SECONDS * np.arange(frames - 1, -1, -1.0)
    position = np.zeros((agents, frames, 2))
    position[:, :, 0] = -np.array(speeds)[:, None] * age
    position[:, :, 1] = _LANE_M * np.arange(agents)[:, None]
    velocity = np.zeros_like(position)
    velocity[:, :, 0] = np.array(speeds)[:, None]
    flat = np.zeros((agents, frames))
    states = AgentStates(
        position=position,
        velocity=velocity,
        acceleration=np.zeros_like(position),
        heading=flat,
        heading_rate=flat,
        first=np.zeros(agents, dtype=np.int64),
        velocity_known=np.ones(agents, dtype=np.bool_),
    )
    raster = Raster(_lanes(agents), np.array([-_MARGIN_M, -_MARGIN_M]), _PIXELS_PER_METER)
    return Scene(types=[kind] * agents, states=states, raster=raster)


def _lanes(count: int) -> Bytes:
    """Return the layers of a straight road along x: [3, rows, columns]."""
    y = np.arange(_PIXELS) / _PIXELS_PER_METER - _MARGIN_M
    lane = np.rint(y / _LANE_M)
    on_road = (lane >= 0) & (lane < count)
    divides = on_road & (np.abs(y - _LANE_M * lane) > (_LANE_M - _DIVIDER_M) / 2)
    layers = np.zeros((3, _PIXELS, _PIXELS), dtype=np.uint8)
    layers[0, :, on_road], layers[1, :, divides] = 1, 1
    return layers


def _fault(mixture: TrajectoryMixture, straight_m: float) -> str | None:
    """Return what is wrong with the forecasts of the agent that stands and the one that moves; None: nothing.

    Args:
        mixture: the forecasts of the two.
        straight_m: the distance that the second one goes at constant speed.
    """
    if not finite(mixture).all():
        return "the forecast holds numbers that are not finite"
    total = mixture.log_weights.double().exp().sum(dim=1)
    if ((total - 1).abs() > _WEIGHT_TOLERANCE).any():
        return f"the weights sum to {total[0]:.3f} and {total[1]:.3f}, not to 1"
    if (torch.linalg.eigvalsh(mixture.covariances.double()) <= 0).any():
        return "a covariance is not positive definite"
    likeliest = mixture.means[torch.arange(2), mixture.log_weights.argmax(dim=1), -1]
    standing_m, moving_m = likeliest.norm(dim=1).tolist()
    if standing_m > _MAX_STANDING_M:
        return f"an agent that stands is forecast {standing_m:.0f} m away"
    if not _MOVING[0] * straight_m <= moving_m <= _MOVING[1] * straight_m:
        return (
            f"an agent that would go {straight_m:.0f} m at constant speed is forecast to go {moving_m:.0f} m"
        )
    return None
