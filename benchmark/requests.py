"""Requests out of recorded scenes, as a driving stack would send them."""

import numpy as np

from benchmark.plan import Call, PlannedScene
from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest, SceneRaster
from cab_forecast import agent, predict_request, scene_raster
from model.arrays import Floats
from model.data.protocols import SceneFrames
from model.forecaster import Protocol
from model.scenes.observations import Observations
from model.scenes.scene import STEP_SECONDS, Raster

REACH_M = 74.0
"""m around an agent that are sent of the map; a far patch reaches 71 m, and where recorded rasters end, 75 m
beyond the tracks, tells where nobody goes."""


class SceneRequests:
    """Makes the requests of one scene.

    By the causal protocol agents are sent with positions and headings, as a stack without derivatives has
    them; by the paper protocol also with velocities, accelerations and heading rates by central differences.

    Args:
        scene: what is asked.
        protocol: of the inputs.
        history_frames: how many frames of history the hungriest of the models uses.
    """

    def __init__(self, scene: PlannedScene, protocol: Protocol, history_frames: int) -> None:
        self._scene = scene
        self._frames = SceneFrames(scene.record, protocol, history_frames)
        self._derived = protocol is Protocol.PAPER

    def request(self, call: Call) -> PredictRequest:
        """The request of a call; it names no model yet.

        All agents that are there go along as context; the map is that around the call's agents.
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
            merge=False,  # The challenge ranks the model's own modes, and the judge merges by itself
            raster=crop(self._scene.record.raster, around),
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


def crop(raster: Raster, around: Floats) -> SceneRaster:
    """The part of a map that some agents can see, on the same pixels.

    Off the map it is one empty pixel: for models of the ground frame nothing is driveable beyond its edge,
    while of no map at all they would know nothing.

    Args:
        raster: of the scene.
        around: [N, 2], m, ground frame: where the agents are.
    """
    scale = raster.pixels_per_meter
    size = np.array(raster.layers.shape[1:])
    low = np.floor((around.min(axis=0) - REACH_M - raster.origin) * scale).clip(0, size).astype(int)
    high = np.ceil((around.max(axis=0) + REACH_M - raster.origin) * scale).clip(0, size).astype(int)
    part = raster.layers[:, low[0] : high[0], low[1] : high[1]]
    if not part.size:
        part = np.zeros((len(part), 1, 1), dtype=np.uint8)
    return scene_raster(part != 0, (raster.origin + low / scale).tolist(), scale)
