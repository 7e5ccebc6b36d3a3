"""Builds observations and states for tests."""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from model.arrays import Floats
from model.scenes.observations import Observations

Path: TypeAlias = Callable[[Floats], Floats]
"""Times [S] → values [S, …]."""


def observations(tracks: Sequence[dict[str, Floats]]) -> Observations:
    """Pads tracks (dicts of time, position and any of heading, velocity, acceleration, heading_rate)."""
    count = np.array([len(track["time"]) for track in tracks], dtype=np.int64)
    agents, most = len(tracks), int(count.max())
    time = np.full((agents, most), np.inf)
    fields = {
        "position": np.zeros((agents, most, 2)),
        "heading": np.full((agents, most), np.nan),
        "velocity": np.full((agents, most, 2), np.nan),
        "acceleration": np.full((agents, most, 2), np.nan),
        "heading_rate": np.full((agents, most), np.nan),
    }
    for n, track in enumerate(tracks):
        time[n, : count[n]] = track["time"]
        for name, values in fields.items():
            if name in track:
                values[n, : count[n]] = track[name]
    return Observations(count=count, time=time, **fields)


def track(times: Floats, path: Path, **given: Path) -> dict[str, Floats]:
    """A track along ``path`` (times [S] → positions [S, 2]); ``given`` likewise, for what is observed."""
    return {"time": times, "position": path(times)} | {name: f(times) for name, f in given.items()}
