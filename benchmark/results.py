"""What a benchmark found, as it is written to ``results.json``."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from pydantic import TypeAdapter, ValidationError

from benchmark import BenchmarkError
from benchmark.files import replace_text, replacing
from model.arrays import Floats
from model.evaluation.results import finite
from model.forecaster import Protocol

RESULTS_FILE = "results.json"
INSTANCES_FILE = "instances.npz"
"""Figures of each pair, for comparisons pair by pair."""
PER_INSTANCE = (
    "ade_ml_6s_m",
    "fde_ml_6s_m",
    "min_ade_5_m",
    "min_ade_10_m",
    "merged_min_ade_5_m",
    "merged_min_ade_10_m",
    "merged_brier_min_fde_5_m",
    "nll",
    "off_road_ml",
    "fde_f_6s_m",
)
"""The figures that ``instances.npz`` holds, as ``<name@version>/<figure>`` [pairs], NaN where missing."""


@dataclass(frozen=True)
class Latency:
    """Of the calls to one model; s. The client's own queue of senders does not count."""

    calls: int
    p50_s: float
    p90_s: float
    p99_s: float
    queue_p50_s: float
    """Of the server's own account: before the model started."""
    inference_p50_s: float
    """Inside the model."""
    batch_agents_mean: float
    """Agents in the batches that calls rode in."""


@dataclass(frozen=True)
class ModelResult:
    """One model, or the physics oracle."""

    name: str
    version: str
    """Empty for the oracle."""
    protocol: str
    """Of the states that it was trained on: "causal", "paper"; "any" where nothing was learned."""
    trained_on: str
    statuses: Mapping[str, int]
    """How many of the pairs came out how: statuses of the contract, and MISSING."""
    metrics: Mapping[str, float]
    """Means over the pairs, by the names of ``model.metrics.evaluate``; over instants, by those of
    ``benchmark.consistency``; ``fde_hardest_1_m`` … ``fde_hardest_3_m`` over the hardest per cent, with
    ``fde_hardest_all_m``; NaN where unknown."""
    instants: int = 0
    """Over how many the means of dispersion and convergence are."""
    lost: int = 0
    """Forecasts that were asked for dispersion and convergence alone, and did not come."""
    latency: Latency | None = None

    @property
    def key(self) -> str:
        """``name@version``; the oracle's name."""
        return f"{self.name}@{self.version}" if self.version else self.name

    @property
    def missing(self) -> int:
        """Forecasts that did not come."""
        return self.statuses.get("MISSING", 0) + self.statuses.get("INVALID", 0) + self.lost

    @property
    def fallbacks(self) -> int:
        """Pairs whose forecast another model made."""
        return self.statuses.get("FALLBACK", 0)


@dataclass(frozen=True)
class Results:
    """All models on the same pairs."""

    data: str
    """Kind of the data set."""
    split: str
    protocol: Protocol
    """Of the inputs."""
    pairs: int
    limit: int | None
    """Only so many of the first pairs were asked for; None: all."""
    consistency: bool
    """Whether dispersion and convergence were asked for."""
    samples: int
    """Trajectories drawn for each pair (ADE-f, FDE-f, OffR-f)."""
    draws: int
    """Positions drawn at each step for calibration."""
    seed: int
    plan: str
    """Digest of what was asked, and of what data."""
    endpoint: str
    concurrency: int
    """Calls on their way at once, when it was last asked; 0: unknown."""
    version: str
    """Of this program."""
    models: tuple[ModelResult, ...]
    refusals: tuple[str, ...] = field(default=())
    """Calls that the endpoint refused, in words."""

    def statement(self) -> str:
        """What the figures are of, in words; belongs to every table."""
        pairs = f"{self.pairs} pairs" if self.limit is None else f"the first {self.pairs} pairs only"
        return f"{self.protocol.value} protocol, {self.data} split {self.split}, {pairs}, seed {self.seed}"

    @property
    def missing(self) -> int:
        """Forecasts of any model that did not come."""
        return sum(model.missing for model in self.models)

    def write(self, folder: Path) -> None:
        """Writes ``results.json``; null for what is not finite.

        Raises:
            OSError: it cannot be written.
        """
        text = json.dumps(finite(asdict(self)), indent=2, allow_nan=False) + "\n"
        replace_text(folder / RESULTS_FILE, text)

    @classmethod
    def read(cls, folder: Path) -> "Results":
        """Reads what ``write`` wrote.

        Raises:
            BenchmarkError: it is not there, or not of this form.
        """
        file = folder / RESULTS_FILE
        try:
            return TypeAdapter(cls).validate_python(_nan(json.loads(file.read_text(encoding="utf-8"))))
        except OSError as error:
            raise BenchmarkError(f"{file}: cannot be read: {error.strerror}") from error
        except (ValueError, AttributeError, TypeError, ValidationError) as error:
            raise BenchmarkError(f"{file}: not a benchmark's results: {error}") from error


def write_instances(folder: Path, figures: Mapping[str, Floats]) -> None:
    """Writes ``instances.npz``: see ``PER_INSTANCE``."""
    with replacing(folder / INSTANCES_FILE) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **figures)  # type: ignore[arg-type]


def read_instances(folder: Path) -> dict[str, Floats]:
    """Reads what ``write_instances`` wrote; nothing where there is no such file.

    Raises:
        BenchmarkError: it is damaged.
    """
    file = folder / INSTANCES_FILE
    if not file.is_file():
        return {}
    try:
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    except (OSError, ValueError, BadZipFile) as error:
        raise BenchmarkError(f"{file}: cannot be read: {error}") from error


def _nan(read: Any) -> Any:
    """Figures that are null are NaN again."""
    for model in read.get("models", []):
        model["metrics"] = {k: math.nan if v is None else v for k, v in model.get("metrics", {}).items()}
    return read
