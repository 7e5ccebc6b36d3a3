"""A made-up scene with one car, and the true state of that car."""

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
"""Id of the agent under test."""
NOW = 1_700_000_000.0
"""s; the present of every scene built here."""
MARGIN = 85.0
"""m by which a raster extends beyond the car and beyond its possible positions in 6 s."""
PIXELS_PER_METER = 3.0

Road = Callable[[Floats, Floats], Bools]
"""Layers [3, ...] (driveable area, road dividers, lane dividers) at the points x, y [...], m, of a scene."""
View = Literal["raster", "patch", "none"]
"""The map in a request: one raster of the scene, the car's own patches, or none."""


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
    """The true state of the car now, without noise."""

    speed: float
    """m/s along the heading; negative: it reverses."""
    acceleration: float = 0.0
    """m/s² along the heading."""
    turned: float = 0.0
    """rad by which the car has turned left since it entered the junction."""
    noisy: bool = False
    """True if the observations are noisy."""
    oriented: bool = True
    """True if the observations determine the heading."""
    companion: str = ""
    """Name of the case to compare with: the same drive without noise and with the full history."""


@dataclass(frozen=True)
class Frame:
    """The car's own frame: origin at the car, x along its heading, y to its left (mirrored: to its right)."""

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
    """A request and the ground truth that its forecast is checked against."""

    name: str
    row: Row
    request: pb.PredictRequest
    frame: Frame
    """The car's true frame."""
    facts: Facts
    raster: Raster | None = None
    """The map; None: no map."""
    lead: Frame | None = None
    """A standing car ahead, relative to the car's frame."""


@dataclass(frozen=True)
class Track:
    """The observations of an agent, in the scene's own frame."""

    times: Floats
    """[F], s relative to now, none positive."""
    positions: Floats
    """[F, 2], m."""
    headings: Floats | None = None
    """[F], rad."""
    velocities: Floats | None = None
    """[F, 2], m/s."""


@dataclass(frozen=True)
class Pose:
    """A scene's pose on the ground: it is first mirrored, then rotated, then shifted."""

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
    """A scene in its own frame: roads start along x, the car drives towards +x on the right."""

    name: str
    row: Row
    car: Track
    position: Floats
    """[2], m, the car's true position now."""
    heading: float
    """rad, the car's true heading now."""
    facts: Facts
    road: Road | None = None
    lead: Track | None = None
    """A standing car."""
    pose: Pose = Pose()
    extent: tuple[tuple[float, float], tuple[float, float]] | None = None
    """Min and max x and y, m, of the car's possible positions in 6 s; None: straight ahead of it."""

    def at(self, pose: Pose) -> "Scenario":
        """Return the scene at another pose."""
        return replace(self, pose=pose)

    def case(self, view: View = "raster") -> Case:
        """Return the request of this scene with the map as ``view``."""
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
        """Return a raster that extends 85 m beyond the car's possible positions in 6 s, and its message."""
        ahead = rotate(np.array([6.0 * max(self.facts.speed, 0.0) + 40.0, 0.0]), np.array(self.heading))
        ends = np.stack([self.position, self.position + ahead])
        low, high = self.extent or (tuple(ends.min(0)), tuple(ends.max(0)))
        return _paint(road, self.pose, low, high)

    def _patch(self, road: Road, pixels_per_meter: float, behind: int) -> Bools:
        """Return a patch painted in the car's own frame, with ``behind`` rows behind the car."""
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


@lru_cache(maxsize=4)  # successive scenes of one drive share their raster
def _paint(
    road: Road, pose: Pose, low: tuple[float, float], high: tuple[float, float]
) -> tuple[Raster, pb.SceneRaster]:
    """Return a raster that extends beyond ``low`` and ``high`` in the scene's frame, and its message."""
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
