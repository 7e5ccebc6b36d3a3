"""Requests from recorded scenes, as a driving stack would send them."""

import math

import numpy as np

from benchmark.plan import Call, PlannedScene
from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest, SceneRaster
from cab_forecast import agent, predict_request, scene_raster
from model.arrays import Floats
from model.data.protocols import SceneFrames
from model.forecaster import Protocol
from model.scenes.observations import Observations
from model.scenes.raster import FAR, NEAR, coarsening
from model.scenes.scene import STEP_SECONDS, Raster

REACH_M = 74.0
"""Range of the map sent around an agent, m. A far patch reaches 71 m. Recorded rasters end 75 m beyond the
tracks; a larger range would reveal where no agent goes."""


class SceneRequests:
    """Requests of one scene.

    By the causal protocol agents are sent with positions and headings, as by a stack without derivatives; by
    the paper protocol also with velocities, accelerations and heading rates by central differences.

    Args:
        scene: the planned scene.
        protocol: protocol of the inputs.
        history_frames: frames of history, the maximum over the models.
    """

    def __init__(self, scene: PlannedScene, protocol: Protocol, history_frames: int) -> None:
        self._scene = scene
        self._frames = SceneFrames(scene.record, protocol, history_frames)
        self._derived = protocol is Protocol.PAPER

    def request(self, call: Call) -> PredictRequest:
        """Return the request of a call, without the model.

        It holds all present agents as context, and the map around the call's agents.
        """
        observations, tracks = self._frames.observations(call.frame)
        wanted = set(call.tracks)
        rows = range(len(tracks))
        agents = [
            self._agent(observations, row, track, track in wanted)
            for row, track in zip(rows, tracks.tolist(), strict=True)
        ]
        newest = observations.position[rows, observations.count - 1]
        around = newest[np.isin(tracks, call.tracks)]
        return predict_request(
            time=call.frame * STEP_SECONDS,
            agents=agents,
            merge=False,  # the metrics need the model's own modes, and merge them themselves
            raster=raster_message(crop(self._scene.record.raster, around)),
        )

    def _agent(self, observations: Observations, row: int, track: int, predict: bool) -> Agent:
        of = self._scene.record.tracks[track]
        seen = slice(0, int(observations.count[row]))
        return agent(
            of.id,
            of.type.value,
            observations.time[row, seen],
            observations.position[row, seen],
            headings=observations.heading[row, seen],
            velocities=observations.velocity[row, seen] if self._derived else None,
            accelerations=observations.acceleration[row, seen] if self._derived else None,
            heading_rates=observations.heading_rate[row, seen] if self._derived else None,
            predict=predict,
        )


def crop(raster: Raster, around: Floats) -> Raster:
    """Return the part of a map that some agents can see, of which their patches are those of the whole map.

    Off the map this is one empty pixel: beyond the edge of a map nothing is driveable, while without a map
    models would treat it as unknown.

    Args:
        raster: map of the scene.
        around: [N, 2], m, ground frame, positions of the agents.
    """
    scale = raster.pixels_per_meter
    size = np.array(raster.layers.shape[1:])
    low = np.floor((around.min(axis=0) - REACH_M - raster.origin) * scale).clip(0, size).astype(int)
    low -= low % math.lcm(*(coarsening(scale, geometry) for geometry in (NEAR, FAR)))
    high = np.ceil((around.max(axis=0) + REACH_M - raster.origin) * scale).clip(0, size).astype(int)
    part = raster.layers[:, low[0] : high[0], low[1] : high[1]]
    if not part.size:
        part = np.zeros((len(part), 1, 1), dtype=np.uint8)
    return Raster(part, raster.origin + low / scale, scale)


def raster_message(raster: Raster) -> SceneRaster:
    """Return a map as the message of a request."""
    return scene_raster(raster.layers != 0, raster.origin.tolist(), raster.pixels_per_meter)
