"""One frame of a real scene (nuScenes prediction data) as a request."""

from pathlib import Path

import numpy as np
from PIL import Image

from cab.forecast.v1 import model_service_pb2 as models
from cab.forecast.v1 import prediction_service_pb2 as pb

X, Y, YAW = 13, 15, 16
STEP = 0.5


def real_request(
    data: Path, split: str, scene: str, frame: int | None = None, history: int = 9
) -> pb.PredictRequest:
    """Return a request for all vehicles at a frame, with up to ``history`` frames, and the scene's raster.

    Args:
        data: folder nuscenes_pred.
        split: "train" or "val".
        scene: name of the scene, such as "scene-0103".
        frame: number of the frame; None: the frame with the most vehicles that have a whole history.
    """
    tracks = real_tracks(data / f"label/{split}/{scene}.txt")

    def whole(at: int) -> int:
        return sum(all(at - k in track for k in range(history)) for track in tracks.values())

    if frame is None:
        frame = max({f for track in tracks.values() for f in track}, key=whole)
    request = pb.PredictRequest(scene_id=scene, time=frame * STEP, scene_raster=real_raster(data, scene))
    for name, track in tracks.items():
        if frame not in track:
            continue
        first = frame
        while first - 1 in track and frame - first + 1 < history:
            first -= 1
        agent = request.agents.add(id=name, type=models.AGENT_TYPE_VEHICLE)
        for f in range(first, frame + 1):
            x, y, yaw = track[f]
            agent.states.add(time=f * STEP, x=x, y=y, heading=yaw)
    return request


def real_tracks(labels: Path) -> dict[str, dict[int, tuple[float, float, float]]]:
    """Return x, y (m) and heading (rad) of a scene's vehicles by frame."""
    tracks: dict[str, dict[int, tuple[float, float, float]]] = {}
    for line in labels.read_text().splitlines():
        row = line.split()
        tracks.setdefault(row[1], {})[int(float(row[0]))] = (float(row[X]), float(row[Y]), float(row[YAW]))
    return tracks


def real_raster(data: Path, scene: str) -> pb.SceneRaster:
    """Return the scene's raster: the files' rows run along x, and their blue is layer 0 (they are BGR)."""
    x, y, scale = map(float, (data / f"map_0.1/meta_{scene}.txt").read_text().split())
    image = np.asarray(Image.open(data / f"map_0.1/{scene}.png").convert("RGB"))[:, :, ::-1]
    bits = np.packbits(np.moveaxis(image >= 128, 2, 0))
    return pb.SceneRaster(
        image=pb.LayerImage(packed_bits=bits.tobytes()),
        rows=image.shape[0],
        columns=image.shape[1],
        origin_x=x,
        origin_y=y,
        pixels_per_meter=scale,
    )
