"""Answered calls, as the recorder gets them."""

from pathlib import Path

import numpy as np

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.scenes.scene import Raster
from service.recording.call import AnsweredCall
from service.recording.folder import RecordingFolder
from tests.cab_forecast.answers import answer
from tests.service.requests import make_request, pack

VERSION = "1.2.3"


def raster(seed: int = 0, side: int = 40) -> Raster:
    """Return a random map."""
    layers = np.random.default_rng(seed).integers(0, 2, (3, side, side), dtype=np.uint8)
    return Raster(layers=layers, origin=np.array([-10.0, -20.0]), pixels_per_meter=2.0)


def answered(
    agents: int = 2, road: Raster | None = None, histories: dict[str, bytes] | None = None, time_ns: int = 1
) -> AnsweredCall:
    """Return an answered call."""
    request = make_request(agents)
    if road is not None:
        _, rows, columns = road.layers.shape
        request.scene_raster.CopyFrom(
            pb.SceneRaster(
                image=pb.LayerImage(packed_bits=pack(road.layers)),
                rows=rows,
                columns=columns,
                origin_x=road.origin[0],
                origin_y=road.origin[1],
                pixels_per_meter=road.pixels_per_meter,
            )
        )
    return AnsweredCall(request, answer(request), road, histories or {}, time_ns)


def folder_at(
    path: Path, *, file_bytes: int = 2**27, files: int = 4, reserve_bytes: int = 0
) -> RecordingFolder:
    """Return a folder with these limits."""
    return RecordingFolder(path, file_bytes, files, reserve_bytes, VERSION)
