"""Recorded scenes made by hand."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from model.data.scenes import DataError, Pair, SceneRecord, Track
from model.geometry import rotate, wrap_angle
from model.scenes.scene import AgentType, Raster


def track(
    name: str,
    position: ArrayLike,
    heading: ArrayLike = 0.0,
    frames: Sequence[int] | None = None,
    kind: AgentType = AgentType.VEHICLE,
) -> Track:
    """Return a track of positions [F, 2] and headings [F] (or one for all), by default from frame 0 on."""
    points = np.asarray(position, dtype=np.float64)
    numbers = np.arange(len(points)) if frames is None else np.asarray(frames)
    headings = np.broadcast_to(np.asarray(heading, dtype=np.float64), len(points)).copy()
    return Track(name, kind, numbers.astype(np.int64), points, headings)


def raster(
    rows: int = 260,
    columns: int = 320,
    origin: tuple[float, float] = (960.0, 1950.0),
    scale: float = 3.0,
    seed: int = 0,
) -> Raster:
    """Return a raster of noise in blocks of four pixels."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 2, (3, -(-rows // 4), -(-columns // 4)), dtype=np.uint8)
    layers = blocks.repeat(4, axis=1).repeat(4, axis=2)[:, :rows, :columns]
    return Raster(np.ascontiguousarray(layers), np.array(origin), scale)


def record(name: str = "scene-1", seed: int = 0, vehicles: int = 4, token: bool = True) -> SceneRecord:
    """Return agents that wander about (1000, 2000) for 24 frames: vehicles, one with a gap and one that comes
    late, and a pedestrian; every vehicle's every possible pair but those right after the gap."""
    rng = np.random.default_rng(seed)
    tracks = []
    for index in range(vehicles + 1):
        kind = AgentType.PEDESTRIAN if index == vehicles else AgentType.VEHICLE
        heading = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(0, 0.1, 24))
        speed = rng.uniform(0, 10) + np.cumsum(rng.normal(0, 0.5, 24))
        steps = np.stack([np.cos(heading), np.sin(heading)], axis=-1) * speed[:, None] / 2
        position = np.array([1000.0, 2000.0]) + rng.uniform(-15, 15, 2) + np.cumsum(steps, axis=0)
        frames = np.arange(24)
        if index == 1:
            frames = np.delete(frames, 5)
        elif index == 2:
            frames = frames[7:]
        kept = track(f"a{index}", position[frames], wrap_angle(heading[frames]), frames.tolist(), kind)
        tracks.append(kept)
    pairs = [
        Pair(index, frame, f"a{index}_{name}-{frame}" if token else "")
        for index, agent in enumerate(tracks[:vehicles])
        for frame in range(int(agent.frames[0]) + 1, 12)
        if not (index == 1 and frame <= 5)
    ]
    pairs.sort(key=lambda pair: (pair.frame, pair.track))
    return SceneRecord(name, tracks, pairs, raster(seed=seed))


def turned(scene: SceneRecord, angle: float, center: ArrayLike) -> SceneRecord:
    """Return the record turned about a point, without its raster."""
    middle = np.asarray(center, dtype=np.float64)
    tracks = [
        Track(
            one.id,
            one.type,
            one.frames,
            middle + rotate(one.position - middle, np.array(angle)),
            wrap_angle(one.heading + angle),
        )
        for one in scene.tracks
    ]
    return SceneRecord(scene.name, tracks, scene.pairs, scene.raster)


class FixedReader:
    """Gives the records that it was made with."""

    def __init__(self, *records: SceneRecord, fails: bool = False) -> None:
        """
        Args:
            records: of the split "some".
            fails: whether reading ends in an error.
        """
        self._records = records
        self._fails = fails

    @property
    def place(self) -> str:
        """Nowhere."""
        return "made up"

    @property
    def splits(self) -> tuple[str, ...]:
        """One with the records and one without."""
        return ("some", "none")

    def scene_count(self, split: str) -> int:
        """Return the number of the records."""
        return len(self._records) if split == "some" else 0

    def scenes(self, split: str) -> Iterator[SceneRecord]:
        """Return the records."""
        if split == "some":
            yield from self._records
        if self._fails:
            raise DataError("scene-9.txt: it is empty")
