"""Results of an evaluation, as written to ``results.json``."""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

from model.forecaster import Protocol

RESULTS_FILE = "results.json"
TABLES_FILE = "tables.md"
SELECTION_SPLIT = "train_val"
"""The split by which ``cab-forecast train`` selects the epoch by default."""


@dataclass(frozen=True, kw_only=True)
class ModelResult:
    """Metrics of one model, or of the physics oracle."""

    name: str
    version: str
    """Empty for the oracle."""
    trained_on: str
    metrics: Mapping[str, float]
    """Means over the pairs, by the names of ``model.metrics.evaluate``; NaN where unknown."""

    @property
    def key(self) -> str:
        """``name@version``; the name of the oracle."""
        return f"{self.name}@{self.version}" if self.version else self.name

    def label(self, inputs: Protocol) -> str:
        """Return the model's name in tables.

        Args:
            inputs: protocol of the inputs.
        """
        return self.key


@dataclass(frozen=True, kw_only=True)
class Results:
    """Results of several models on the same pairs."""

    data: str
    """Kind of the data set."""
    split: str
    protocol: Protocol
    """Protocol of the inputs."""
    pairs: int
    limit: int | None
    """Number of pairs, from the first, that were requested; None: all."""
    samples: int
    """Trajectories drawn for each pair (ADE-f, FDE-f, OffR-f); 0: none."""
    draws: int
    """Positions drawn at each step for calibration; 0: none."""
    models: tuple[ModelResult, ...]

    def statement(self) -> str:
        """Return what the figures are computed on, in words; every table carries it."""
        pairs = f"{self.pairs} pairs" if self.limit is None else f"the first {self.pairs} pairs only"
        return f"{self.protocol.value} protocol, {self.data} split {self.split}, {pairs}"

    def document(self) -> dict[str, object]:
        """Return the contents of ``results.json``."""
        return asdict(self)

    def write(self, folder: Path) -> None:
        """Write ``results.json``; numbers that are not finite become null.

        Args:
            folder: an existing folder.

        Raises:
            OSError: the file cannot be written.
        """
        text = json.dumps(_finite(self.document()), indent=2, allow_nan=False) + "\n"
        replace_text(folder / RESULTS_FILE, text)


@dataclass(frozen=True, kw_only=True)
class EvaluationModelResult(ModelResult):
    """Metrics of one model of an evaluation in this process."""

    learned: bool
    ablated: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """Metrics without "map", "neighbors" or "both"; only of what the model uses."""


@dataclass(frozen=True, kw_only=True)
class EvaluationResults(Results):
    """Results of an evaluation in this process."""

    models: tuple[EvaluationModelResult, ...]
    ablate: bool
    """True if models were also evaluated with less context."""

    def statement(self) -> str:
        """Return what the figures are computed on, in words; every table carries it."""
        samples = f"{self.samples} sampled trajectories a pair" if self.samples else "no sampled trajectories"
        selected = self.split == SELECTION_SPLIT and any(model.learned for model in self.models)
        epochs = f"; epochs of learned models were selected on {SELECTION_SPLIT}" if selected else ""
        return f"{super().statement()}, {samples}{epochs}"

    def document(self) -> dict[str, object]:
        """Return the contents of ``results.json``, where the models are ``rows``."""
        contents = super().document()
        contents["rows"] = contents.pop("models")
        return contents


@contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Give a temporary file that replaces the real one on success; on failure the old file stays.

    Raises:
        OSError: the file cannot be written.
    """
    temporary = file.with_name(f"{file.name}.new")
    try:
        yield temporary
        temporary.replace(file)
    finally:
        temporary.unlink(missing_ok=True)


def replace_text(file: Path, text: str) -> None:
    """Write a text file, whole or not at all.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _finite(value: object) -> object:
    """Return a value as JSON can hold it: null for numbers that are not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): _finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return value
