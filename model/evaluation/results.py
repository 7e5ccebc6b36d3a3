"""What an evaluation found."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from model.forecaster import Protocol

CHOSEN_ON = "train_val"
"""The split by which ``cab-forecast train`` chooses the epoch, unless told otherwise."""


@dataclass(frozen=True)
class Row:
    """One model."""

    name: str
    version: str
    """Empty for the oracle."""
    learned: bool
    trained_on: str
    metrics: Mapping[str, float]
    """Means over the pairs, by the names of ``model.metrics.evaluate``."""
    ablated: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """The same without "map", "neighbors" or "both"; of a learned model, what it looks at."""


@dataclass(frozen=True)
class Results:
    """All models on the same pairs."""

    data: str
    """Kind of the data set."""
    split: str
    protocol: Protocol
    pairs: int
    limit: int | None
    """Only so many of the first pairs were asked for; None: all."""
    samples: int
    """Trajectories drawn for each pair; 0: none, and no calibration."""
    draws: int
    """Positions drawn at each step for calibration."""
    ablate: bool
    """Whether context was taken away."""
    rows: tuple[Row, ...]

    def statement(self) -> str:
        """What the figures are of, in words; belongs to every table."""
        pairs = f"{self.pairs} pairs" if self.limit is None else f"the first {self.pairs} pairs only"
        samples = f"{self.samples} sampled trajectories a pair" if self.samples else "no sampled trajectories"
        judged = self.split == CHOSEN_ON and any(row.learned for row in self.rows)
        chosen = f"; epochs of learned models were chosen on {CHOSEN_ON}" if judged else ""
        return f"{self.protocol.value} protocol, {self.data} split {self.split}, {pairs}, {samples}" + chosen

    def to_json(self) -> str:
        """All figures; null for what is not finite."""
        return json.dumps(finite(asdict(self)), indent=2, allow_nan=False) + "\n"


def finite(value: object) -> object:
    """A value as JSON can hold it: null for numbers that are not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [finite(part) for part in value]
    return value
