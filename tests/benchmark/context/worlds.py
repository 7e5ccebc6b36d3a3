"""Made-up scenes in which map and neighbours tell where an agent goes, and forecasters that look or do not.

In each scene an agent goes straight at 8 m/s. From now on it follows the bend of its road at the speed of the
vehicle ahead; both are others in each scene.
"""

import numpy as np
import torch

from model.arrays import Floats, Ints
from model.baselines.unimodal import unimodal
from model.data.scenes import Pair, SceneRecord
from model.forecaster import Context, Features, Forecaster, ModelInfo, Protocol
from model.geometry import rotate
from model.metrics.offroad import off_road
from model.metrics.path_fan import CURVATURES
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentType, Raster, Scene
from tests.model.data.records import track

SPEED = 8.0
NOW = 5
CURVES = (-0.04, -0.02, 0.0, 0.02, 0.04, 0.06)
SPEEDS = (9.0, 8.0, 7.0, 6.0, 5.0, 4.0)
_WIDTH = 3.0


def arc(curvature: float, length: Floats) -> Floats:
    """Points [N, 2] of a bend that begins at the origin, along x, after lengths [N]."""
    turned = curvature * length
    return np.stack(
        [length * np.sinc(turned / np.pi), length * np.sin(turned / 2) * np.sinc(turned / 2 / np.pi)], axis=-1
    )


def world(number: int, heading: float, origin: tuple[float, float]) -> SceneRecord:
    """The scene of one agent, which has one pair, and of the vehicle ahead."""
    curvature, speed = CURVES[number], SPEEDS[number]

    def placed(points: Floats) -> Floats:
        return np.array(origin) + rotate(points, np.array(heading))

    past = np.stack([0.5 * SPEED * np.arange(-NOW, 1), np.zeros(NOW + 1)], axis=-1)
    ahead: Floats = 0.5 * speed * np.arange(1.0, 13.0)
    agent = np.concatenate([past, arc(curvature, ahead)])
    turned = np.concatenate([np.zeros(NOW + 1), curvature * ahead])
    lead = np.stack([20 + 0.5 * speed * np.arange(-NOW, 13), np.zeros(NOW + 13)], axis=-1)
    tracks = [track("agent", placed(agent), heading + turned), track("lead", placed(lead), heading)]
    return SceneRecord(f"world-{number}", tracks, [Pair(0, NOW)], _road(curvature, heading, np.array(origin)))


def _road(curvature: float, heading: float, origin: Floats) -> Raster:
    scale, reach = 3.0, 110.0
    size = int(2 * reach * scale)
    corner = origin - reach
    grid = corner + np.stack(np.meshgrid(np.arange(size), np.arange(size), indexing="ij"), axis=-1) / scale
    local = rotate(grid - origin, np.array(-heading))
    straight = (local[..., 0] <= 0) & (np.abs(local[..., 1]) < _WIDTH)
    if curvature:
        center = np.array([0.0, 1 / curvature])
        radius = np.hypot(*np.moveaxis(local - center, -1, 0))
        bend = (
            np.abs(radius - abs(1 / curvature)) < _WIDTH
        )  # a whole circle, so that no path comes to its end
    else:
        bend = (local[..., 0] >= 0) & (np.abs(local[..., 1]) < _WIDTH)
    layers = np.zeros((3, size, size), dtype=np.uint8)
    layers[0] = straight | bend
    return Raster(layers, corner, scale)


WORLDS = tuple(
    world(number, heading=0.9 * number - 2, origin=(500.0 * number, -300.0 * number))
    for number in range(len(CURVES))
)


class Follower(Forecaster):
    """Follows the road at the speed of the nearest other agent, if it looks at them; else goes straight."""

    def __init__(self, name: str, *, uses_map: bool, uses_neighbors: bool) -> None:
        self.info = ModelInfo(
            name=name,
            version="1.0.0",
            protocol=Protocol.CAUSAL,
            description="made up",
            agent_types=(AgentType.VEHICLE,),
            context_types=(AgentType.VEHICLE,),
            history_frames=5,
            modes=1,
            uses_map=uses_map,
            uses_neighbors=uses_neighbors,
            supports_blind=False,
            license="none",
        )

    def prepare(self, scene: Scene, targets: Ints, context: Context = Context.FULL) -> Features:
        paths = np.stack([self._path(scene, int(target)) for target in targets])
        return {
            "origin": torch.from_numpy(scene.states.position[targets, -1]),
            "path": torch.from_numpy(paths),
        }

    def _path(self, scene: Scene, target: int) -> Floats:
        position, speeds = scene.states.position[:, -1], np.hypot(*scene.states.velocity[:, -1].T)
        heading = scene.states.heading[target, -1]
        distance = np.hypot(*(position - position[target]).T)
        distance[target] = np.inf
        seen = self.info.uses_neighbors and len(distance) > 1
        length = speeds[distance.argmin() if seen else target] * 0.5 * np.arange(1, 13)
        tight_last = CURVATURES[np.argsort(np.abs(CURVATURES), kind="stable")]
        fan: Floats = np.stack([rotate(arc(c, length), np.array(heading)) for c in tight_last])
        chosen = 0
        if self.info.uses_map:
            assert scene.raster is not None
            free = off_road(scene.raster, position[target] + fan) == 0
            chosen = int(free.argmax())
        path: Floats = fan[chosen]
        return path

    def forecast(
        self,
        features: Features,
        agent_type: AgentType,
        context: Context = Context.FULL,
        steps: int | None = None,
    ) -> TrajectoryMixture:
        paths = features["path"]
        return unimodal(paths, torch.eye(2).expand(*paths.shape[:2], 2, 2), features["origin"])
