"""A made-up scene with one car in it, and what is known of that car."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache
from typing import Literal

import numpy as np

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab_forecast import agent, map_patch, predict_request, scene_raster
from model.arrays import Bools, Floats
from model.geometry import rotate
from model.scenes.scene import Raster

CAR = "car"
"""Id of the agent that is asked about."""
NOW = 1_700_000_000.0
"""s; the present of every scene built here."""
MARGIN = 85.0
"""m that a raster reaches beyond the car and beyond where it may be in 6 s."""
PIXELS_PER_METER = 3.0

Road = Callable[[Floats, Floats], Bools]
"""Layers [3, ...] (driveable area, road dividers, lane dividers) at the points x, y [...], m, of a scene."""
View = Literal["raster", "patch", "none"]
"""How a request shows the map: one raster of the scene, the car's own patches, or not at all."""


class Row(StrEnum):
    """The kinds of cases, each with bands of its own."""

    STANDING = "standing"
    SIDEWAYS = "standing, slips sideways"
    PARKED = "parked at the kerb"
    CREEPING = "creeping"
    FLIP = "heading flips in the last frame"
    REVERSE = "reversing"
    STRAIGHT = "straight on"
    NOISY_HEADINGS = "noisy headings"
    HIGHWAY = "highway"
    ACCELERATING = "accelerating"
    BRAKING = "braking"
    CURVE = "curve ahead"
    JUNCTION = "junction ahead"
    LEFT_TURN = "within a left turn"
    LEAD = "standing lead"
    SHORT = "one or two states"


@dataclass(frozen=True)
class Facts:
    """What a judge knows of the car now, noise apart."""

    speed: float
    """m/s along the heading; negative: it reverses."""
    acceleration: float = 0.0
    """m/s² along the heading."""
    turned: float = 0.0
    """rad to the left that it has turned since it came to the junction."""
    noisy: bool = False
    """Whether the observations are."""
    oriented: bool = True
    """Whether the observations tell its heading."""
    companion: str = ""
    """Name of the case that this one is compared with: the same drive, clean and with its whole history."""


@dataclass(frozen=True)
class Frame:
    """The car's own frame: origin where it is, x along its heading, y to its left (mirrored: its right)."""

    position: Floats
    """[2], m, ground frame."""
    heading: float
    """rad."""
    mirrored: bool = False

    def to_local(self, points: Floats) -> Floats:
        """Return ground points [..., 2], m, in this frame."""
        local = rotate(points - self.position, np.full(points.shape[:-1], -self.heading))
        return local * (1.0, -1.0) if self.mirrored else local

    def to_ground(self, points: Floats) -> Floats:
        """Return points [..., 2], m, of this frame on the ground."""
        flipped = points * (1.0, -1.0) if self.mirrored else points
        return rotate(flipped, np.full(points.shape[:-1], self.heading)) + self.position

    def covariances_to_local(self, covariances: Floats) -> Floats:
        """Return covariances [..., 2, 2], m², of ground positions in this frame."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        turn = np.array([[cos, sin], [-sin, cos]])
        if self.mirrored:
            turn[1] *= -1
        local: Floats = turn @ covariances @ turn.T
        return local


@dataclass(frozen=True)
class Case:
    """A request, and what its answer is judged by."""

    name: str
    row: Row
    request: pb.PredictRequest
    frame: Frame
    """Of the car, where it truly is."""
    facts: Facts
    raster: Raster | None = None
    """The map; None: there is none."""
    lead: Frame | None = None
    """A standing car ahead, relative to the car's frame."""


@dataclass(frozen=True)
class Track:
    """What was observed of an agent, in the scene's own frame."""

    times: Floats
    """[F], s from now, none positive."""
    positions: Floats
    """[F, 2], m."""
    headings: Floats | None = None
    """[F], rad."""
    velocities: Floats | None = None
    """[F, 2], m/s."""


@dataclass(frozen=True)
class Pose:
    """Where a scene lies on the ground: it is mirrored first, then turned, then shifted."""

    x: float = 0.0
    y: float = 0.0
    angle: float = 0.0
    """rad."""
    mirrored: bool = False

    def frame(self) -> Frame:
        """Return the scene's frame on the ground."""
        return Frame(np.array([self.x, self.y]), self.angle, self.mirrored)


@dataclass(frozen=True)
class Scenario:
    """A scene in its own frame: roads run along x, or begin so; the car drives towards +x, on the right."""

    name: str
    row: Row
    car: Track
    position: Floats
    """[2], m, where the car truly is now."""
    heading: float
    """rad, the car's true one now."""
    facts: Facts
    road: Road | None = None
    lead: Track | None = None
    """A standing car."""
    pose: Pose = Pose()
    extent: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Least and greatest x and y, m, of where the car may be in 6 s; None: straight ahead of it."""

    def at(self, pose: Pose) -> "Scenario":
        """Return the same scene elsewhere on the ground."""
        return replace(self, pose=pose)

    def case(self, view: View = "raster") -> Case:
        """Return the request of this scene, the map shown as ``view`` says."""
        scene = self.pose.frame()
        sign = -1.0 if self.pose.mirrored else 1.0
        frame = Frame(
            scene.to_ground(self.position), self.pose.angle + sign * self.heading, self.pose.mirrored
        )
        cars = [_agent(CAR, self.car, scene)]
        if self.lead is not None:
            cars.append(_agent("lead", self.lead, scene))
        if self.road is not None and view == "patch":
            cars[0].map_patch.CopyFrom(map_patch(self._patch(self.road, 3.0, 10)))
            cars[0].far_map_patch.CopyFrom(map_patch(self._patch(self.road, 1.4, 14)))
        request = predict_request(NOW, cars, merge=False)
        raster = None
        if self.road is not None and view == "raster":
            raster, sent = self._raster(self.road)
            request.scene_raster.CopyFrom(sent)
        return Case(self.name, self.row, request, frame, self.facts, raster, self._lead_ahead())

    def _lead_ahead(self) -> Frame | None:
        """Return the lead in the car's frame."""
        if self.lead is None or self.lead.headings is None:
            return None
        car = Frame(self.position, self.heading)
        return Frame(car.to_local(self.lead.positions[-1]), float(self.lead.headings[-1]) - self.heading)

    def _raster(self, road: Road) -> tuple[Raster, pb.SceneRaster]:
        """Return the road as a raster that reaches 85 m beyond all places where the car may be in 6 s, as the
        judge has it and as it is sent."""
        ahead = rotate(np.array([6.0 * max(self.facts.speed, 0.0) + 40.0, 0.0]), np.array(self.heading))
        ends = np.stack([self.position, self.position + ahead])
        low, high = self.extent or (tuple(ends.min(0)), tuple(ends.max(0)))
        return _paint(road, self.pose, low, high)

    def _patch(self, road: Road, pixels_per_meter: float, behind: int) -> Bools:
        """Return a patch of the car's own, painted anew in its own frame, with so many rows behind it."""
        ahead, left = (np.arange(100) - behind) / pixels_per_meter, (np.arange(100) - 50) / pixels_per_meter
        points = np.stack(np.meshgrid(ahead, left, indexing="ij"), axis=-1)
        if self.pose.mirrored:
            points = points * (1.0, -1.0)
        local = Frame(self.position, self.heading).to_ground(points)
        return road(local[..., 0], local[..., 1])


def _agent(name: str, track: Track, scene: Frame) -> pb.Agent:
    turn = Frame(np.zeros(2), scene.heading, scene.mirrored)
    sign = -1.0 if scene.mirrored else 1.0
    return agent(
        name,
        "vehicle",
        NOW + track.times,
        scene.to_ground(track.positions),
        headings=None if track.headings is None else scene.heading + sign * track.headings,
        velocities=None if track.velocities is None else turn.to_ground(track.velocities),
    )


@lru_cache(maxsize=4)  # successive scenes of one drive share theirs
def _paint(
    road: Road, pose: Pose, low: tuple[float, float], high: tuple[float, float]
) -> tuple[Raster, pb.SceneRaster]:
    """Return the raster of a road that reaches beyond an extent in the scene's frame, and its message."""
    (left, bottom), (right, top) = low, high
    corners = [(x, y) for x in (left - MARGIN, right + MARGIN) for y in (bottom - MARGIN, top + MARGIN)]
    scene = pose.frame()
    on_ground = scene.to_ground(np.array(corners))
    origin = np.floor(on_ground.min(0))
    rows, columns = np.ceil((on_ground.max(0) - origin) * PIXELS_PER_METER).astype(int)
    pixels = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), axis=-1)
    local = scene.to_local(origin + pixels / PIXELS_PER_METER)
    layers = road(local[..., 0], local[..., 1])
    return (
        Raster(layers.astype(np.uint8), origin, PIXELS_PER_METER),
        scene_raster(layers, tuple(origin), PIXELS_PER_METER),
    )
