"""Binary records of the track memory, the same in every store.

All numbers are little-endian. A forecast is one block for the current time and one for each step of 0.5 s, so
that the steps around an instant are contiguous.
"""

from typing import Any

import numpy as np

from model.arrays import Floats, Ints
from model.mixture import TrajectoryMixture
from model.scenes.observations import Observations
from model.scenes.scene import AgentType

AGES = 12
"""Ages at which forecasts are compared: k · 0.5 s, k = 1 … 12."""
MODES = 5
"""Modes of a forecast that are stored, the most likely ones."""

OBSERVATION_FIELDS = 9
"""time s; x, y m; heading rad; velocity m/s; acceleration m/s²; heading rate rad/s. NaN: not given."""
OBSERVATION_BYTES = 8 * OBSERVATION_FIELDS

FORECAST_BLOCKS = AGES + 2
"""Blocks of a forecast: the current time, each step, and one of NaN after the last step."""

BLOCK = np.dtype([("point", "<f8", (2,)), ("others", "<f4", (MODES - 1, 2))])
"""One step: the most likely mode, m, ground frame, and the next modes relative to it, m; NaN where the
forecast has fewer modes."""

FORECAST_BYTES = FORECAST_BLOCKS * BLOCK.itemsize

INSTANT = np.dtype(
    [
        ("flags", "<u8"),
        ("time", "<f8"),
        ("position", "<f8", (2,)),
        ("made_at", "<f8", (AGES,)),
        ("blocks", BLOCK, (AGES, 3)),
    ]
)
"""An observation with one model's forecasts for it: ``COMPLETE``, ``SETTLED`` and ``NEWLY``; time, s;
position of the agent, m; and by age, the time of the forecast, s, and its steps before, at and after the age.
NaN where there is no forecast, and after its end."""

COMPLETE = 1
"""Flag: there is a forecast of each age."""
SETTLED = 2
"""Flag: the set is final."""
NEWLY = 4
"""Flag: the set became final in this call, and is aggregated now."""

AGENT_TYPES = {
    AgentType.VEHICLE: b"v",
    AgentType.PEDESTRIAN: b"p",
    AgentType.CYCLIST: b"c",
    AgentType.UNKNOWN: b"u",
}
"""Bytes of the agent types."""


def pack_observations(observations: Observations, newest_only: bool) -> list[bytes]:
    """Return the observations of each agent, ascending by time.

    Args:
        observations: observations of N agents.
        newest_only: whether to return only the last observation of each agent.

    Returns:
        N times n · ``OBSERVATION_BYTES`` bytes.
    """
    table = np.concatenate(
        [
            observations.time[:, :, None],
            observations.position,
            observations.heading[:, :, None],
            observations.velocity,
            observations.acceleration,
            observations.heading_rate[:, :, None],
        ],
        axis=2,
    ).astype("<f8", copy=False)
    counts = observations.count.tolist()
    if newest_only:
        newest = table[np.arange(len(counts)), observations.count - 1]
        return _rows(newest.tobytes(), OBSERVATION_BYTES)
    return [table[row, :count].tobytes() for row, count in enumerate(counts)]


def unpack_observations(packed: list[bytes]) -> Observations:
    """Return the observations in some bytes.

    Args:
        packed: [N], at least one observation each.
    """
    counts: Ints = np.array([len(each) // OBSERVATION_BYTES for each in packed], dtype=np.int64)
    table = np.full((len(packed), int(counts.max()), OBSERVATION_FIELDS), np.nan)
    table[:, :, 0] = np.inf
    flat = np.frombuffer(b"".join(packed), dtype="<f8").reshape(-1, OBSERVATION_FIELDS)
    rows = np.repeat(np.arange(len(counts)), counts)
    columns = np.arange(len(flat)) - np.repeat(np.cumsum(counts) - counts, counts)
    table[rows, columns] = flat
    return Observations(
        count=counts,
        time=table[:, :, 0],
        position=table[:, :, 1:3],
        heading=table[:, :, 3],
        velocity=table[:, :, 4:6],
        acceleration=table[:, :, 6:8],
        heading_rate=table[:, :, 8],
    )


def split_observations(packed: bytes) -> list[list[float]]:
    """Return the observations of one agent: a row of ``OBSERVATION_FIELDS`` numbers each."""
    rows: list[list[float]] = np.frombuffer(packed, dtype="<f8").reshape(-1, OBSERVATION_FIELDS).tolist()
    return rows


def pack_forecasts(mixture: TrajectoryMixture) -> list[bytes]:
    """Return the forecast of each agent: ``FORECAST_BLOCKS`` blocks, NaN after the last step.

    Args:
        mixture: forecasts of N agents, at most ``AGES`` steps.
    """
    # In numpy: a thread that calls torch starts helper threads, which would slow the model down
    order = np.argsort(-mixture.log_weights.numpy(), axis=1, kind="stable")[:, :MODES]
    rows = np.arange(len(mixture))[:, None]
    means = mixture.means.numpy()[rows, order].astype(np.float64)  # [N, M, T, 2]
    origin: Floats = mixture.origin.numpy()
    agents, modes, steps, _ = means.shape
    table = np.full((agents, FORECAST_BLOCKS), np.nan, dtype=BLOCK)
    table["point"][:, 0] = origin
    table["point"][:, 1 : steps + 1] = means[:, 0] + origin[:, None]
    table["others"][:, 0, : modes - 1] = 0.0
    table["others"][:, 1 : steps + 1, : modes - 1] = (means[:, 1:] - means[:, :1]).transpose(0, 2, 1, 3)
    return _rows(table.tobytes(), FORECAST_BYTES)


def unpack_instants(packed: bytes) -> "np.ndarray[Any, np.dtype[np.void]]":
    """Return [P] of ``INSTANT``."""
    return np.frombuffer(packed, dtype=INSTANT)


def _rows(flat: bytes, size: int) -> list[bytes]:
    return [flat[start : start + size] for start in range(0, len(flat), size)]
