"""Recorded scenes for the benchmark, in memory and on disk."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from benchmark.plan import PlannedScene, plan_scenes
from model.data.scenes import SceneRecord
from model.scenes.scene import AgentType
from tests.model.data.records import FixedReader, record

RECORDS = (record(), record("scene-2", seed=1))
READER = FixedReader(*RECORDS)
PAIRS = sum(len(one.pairs) for one in RECORDS)


def planned(consistency: bool = True, limit: int | None = None) -> list[PlannedScene]:
    """Plan of ``RECORDS``."""
    return list(plan_scenes(READER, "some", consistency=consistency, limit=limit))


def write_nuscenes_pred(folder: Path, records: Sequence[SceneRecord] = RECORDS) -> Path:
    """Records as a data set of the layout nuscenes_pred, split train_val; it holds vehicles only."""
    labels, maps = folder / "label/val", folder / "map_0.1"
    labels.mkdir(parents=True)
    maps.mkdir()
    for one in records:
        due = {(pair.track, pair.frame) for pair in one.pairs}
        rows = [
            f"{frame}.0 {index}.0 Car {'-1.0 ' * 7}1.8 1.5 4.5 "
            f"{x!r} 1.0 {y!r} {yaw!r} {int((index, frame) in due)}.0"
            for index, track in enumerate(one.tracks)
            if track.type is AgentType.VEHICLE
            for frame, (x, y), yaw in zip(
                track.frames.tolist(), track.position.tolist(), track.heading.tolist(), strict=True
            )
        ]
        (labels / f"{one.name}.txt").write_text("\n".join(rows) + "\n")
        origin_x, origin_y = one.raster.origin.tolist()
        (maps / f"meta_{one.name}.txt").write_text(f"{origin_x} {origin_y} {one.raster.pixels_per_meter}\n")
        pixels = np.moveaxis(one.raster.layers[::-1], 0, 2) * 255  # as cv2 writes it: layer 0 is blue
        Image.fromarray(np.ascontiguousarray(pixels)).save(maps / f"{one.name}.png")
    return folder


def without_tokens(one: SceneRecord) -> SceneRecord:
    """The record as from data without the challenge's tokens."""
    return replace(one, pairs=[replace(pair, token="") for pair in one.pairs])
