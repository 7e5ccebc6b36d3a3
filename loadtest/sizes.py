"""Sizes of requests and responses by their encoding: ``python -m loadtest.sizes``."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

import model
from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab_forecast import Client, map_patch, scene_raster
from loadtest.requests import PIXELS, Encoding, encode, made_up_requests, scene_of
from loadtest.servers import serving
from model.scenes.raster import FAR, NEAR, cut_patches

FRAMES = 5
"""History frames of a scene whose patches are cut."""
MERGED = 5
"""Number of merged modes that a planner asks for."""


def with_png(request: PredictRequest) -> PredictRequest:
    """Return a request whose raster is a PNG."""
    bits = np.unpackbits(np.frombuffer(request.scene_raster.image.packed_bits, dtype=np.uint8))
    raster = scene_raster(bits.reshape(3, PIXELS, PIXELS), (0.0, 0.0), 1.0, "png")
    return _changed(request, raster.SerializeToString())


def with_patches(request: PredictRequest) -> PredictRequest:
    """Return a request whose agents bring a near and a far patch each, in place of the raster."""
    scene = scene_of(request, FRAMES)
    if scene.raster is None:
        raise ValueError("the request has no raster")
    position, heading = scene.states.position[:, -1], scene.states.heading[:, -1]
    near, far = (cut_patches(scene.raster, position, heading, one) > 0.5 for one in (NEAR, FAR))
    changed = _changed(request)
    for agent, own, distant in zip(changed.agents, near, far, strict=True):
        agent.map_patch.CopyFrom(map_patch(own))
        agent.far_map_patch.CopyFrom(map_patch(distant))
    return changed


def _changed(request: PredictRequest, raster: bytes | None = None) -> PredictRequest:
    """Return a request with another raster, or with none."""
    changed = PredictRequest()
    changed.CopyFrom(request)
    changed.ClearField("scene_raster")
    if raster is not None:
        changed.scene_raster.MergeFromString(raster)
    return changed


def main(
    agents: Annotated[
        list[int] | None, typer.Option(min=1, help="vehicles a call; default: 1, 8, 32")
    ] = None,
    name: Annotated[str, typer.Option("--model")] = "cab",
) -> None:
    """Print the sizes of made-up requests and of the answers of a server that this command starts."""
    counts = agents or [1, 8, 32]
    table = Table(title=f"kB a call, {name}, a raster of {PIXELS} × {PIXELS} pixels")
    table.add_column("")
    for count in counts:
        table.add_column(f"{count} agents", justify="right")
    rows: dict[str, list[int]] = {}

    def add(row: str, size: int) -> None:
        rows.setdefault(row, []).append(size)

    with (
        serving(Path(next(iter(model.__path__))) / "checkpoints") as server,
        Client(f"grpc://{server.grpc}") as client,
    ):
        for count in counts:
            [made] = made_up_requests(name, count, scenes=1)
            request = made.message
            add("request, raster", len(made.body))
            add("request, raster as PNG", with_png(request).ByteSize())
            add("request, a near and a far patch for each agent", with_patches(request).ByteSize())
            add("request, no map", _changed(request).ByteSize())
            add("request, raster, JSON", len(encode(request, Encoding.JSON)))
            answer = client.predict(request)
            add("answer, all modes", answer.ByteSize())
            add("answer, all modes, JSON", len(encode(answer, Encoding.JSON)))
            request.options.max_modes = MERGED
            request.options.merge = True
            answer = client.predict(request)
            add(f"answer, {MERGED} merged modes", answer.ByteSize())
            add(f"answer, {MERGED} merged modes, JSON", len(encode(answer, Encoding.JSON)))
    for row, sizes in rows.items():
        table.add_row(row, *(f"{size / 1000:.1f}" for size in sizes))
    Console().print(table)


if __name__ == "__main__":
    typer.run(main)
