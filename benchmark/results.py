"""Results of a benchmark: ``results.json``, and the figures of each pair in ``instances.npz``."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np
from pydantic import TypeAdapter, ValidationError

from benchmark.bootstrap import Ratio
from benchmark.errors import BenchmarkError
from benchmark.models import KALMAN, oldest_first
from model.arrays import Floats, Ints
from model.evaluation.results import RESULTS_FILE, ModelResult, Results, replacing
from model.forecaster import Protocol
from model.metrics.hard import HARD_SHARES, hardest_of_known

INSTANCES_FILE: Final = "instances.npz"
"""Figures of each pair, for paired comparisons of two runs."""
PER_INSTANCE: Final = (
    "ade_ml_6s_m",
    "fde_ml_6s_m",
    "fde_merged_6s_m",
    "min_ade_5_m",
    "min_ade_10_m",
    "merged_min_ade_5_m",
    "merged_min_ade_10_m",
    "merged_brier_min_fde_5_m",
    "nll",
    "off_road_ml",
    "fde_f_6s_m",
)
"""Figures in ``instances.npz``, as ``<name@version>/<figure>`` [pairs], NaN where missing."""
FDE: Final = "fde_ml_6s_m"
HARDEST_FDE: Final = {f"fde_hardest_{round(100 * share)}_m": share for share in HARD_SHARES}
"""Shares of the pairs by the name of the mean FDE over them."""
ALL: Final = "all"
HARDEST: Final = "hardest 10 %"
TURNS: Final = "turns after now"
"""Subsets of the pairs, over which the use of the context is measured."""
_SCENES: Final = "scenes"
"""Entry of ``instances.npz``: [pairs], the index of each pair's scene."""
_SUBSET: Final = ", "
_SCENE_SUMS: Final = "scene sums/"
"""Beginning of the names of entries of ``instances.npz`` with a row for each scene."""


def subset_figure(measure: str, subset: str) -> str:
    """Return the name of a measure of the context over a subset of the pairs, among a model's figures."""
    return measure if subset == ALL else f"{measure}{_SUBSET}{subset}"


@dataclass(frozen=True)
class Latency:
    """Durations of the calls to one model; the client's own queue of senders does not count."""

    calls: int
    p50_s: float
    p90_s: float
    p99_s: float
    queue_p50_s: float
    """Time before the model started, as the server reports it."""
    inference_p50_s: float
    """Time inside the model, as the server reports it."""
    batch_agents_mean: float
    """Mean number of agents in the batches."""


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % interval."""

    value: float
    low: float
    high: float
    pairs: int
    """Number of pairs that it is of."""


@dataclass(frozen=True)
class ContextRun:
    """Settings and time of the measurement of the use of the context."""

    no_context: str
    """``name@version`` of the model without context."""
    donors: int
    """Maximum number of donors of a pair."""
    cases: int
    """Number of forecasts of each learned model with a changed context; physics baselines see none."""
    timed: int
    """Number of forecasts that were timed: of all models, without those of replays that were killed."""
    seconds: float
    """Time that these took; it is no part of the benchmark's."""


@dataclass(frozen=True)
class ExplanationRun:
    """Settings of the explanations."""

    pairs: int
    """Number of pairs that were to be explained."""
    baseline: str
    """Stand-in for absent parts: "donors", where they fit, or "null_context"."""


@dataclass(frozen=True, kw_only=True)
class BenchmarkModelResult(ModelResult):
    """Figures of one model, or of the physics oracle.

    Besides the means over the pairs, ``metrics`` holds means over instants, by the names of
    ``evaluate.CONSISTENCY``, and ``fde_hardest_1_m`` … ``fde_hardest_3_m`` over the hardest per cent of the
    pairs, with ``fde_hardest_all_m``.
    """

    protocol: str
    """Protocol of the training data: "causal", "paper"; "any" where nothing was learned."""
    statuses: Mapping[str, int]
    """Number of pairs by status of the contract, or MISSING."""
    instants: int = 0
    """Number of instants in the means of dispersion and convergence."""
    lost: int = 0
    """Missing forecasts among those requested for dispersion and convergence only."""
    latency: Latency | None = None
    context: Mapping[str, Mapping[str, Estimate]] = field(default_factory=dict)
    """Effects of the context on the forecasts, by subset of the pairs and by name of the measure (see
    ``benchmark.context.measures``)."""
    explanation: Mapping[str, Estimate] = field(default_factory=dict)
    """Mean Shapley values of state, map and neighbors, m: how much nearer they bring the most likely end
    point to where it is with everything present."""
    context_missing: int = 0
    """Missing forecasts among those with a changed context."""

    @property
    def missing(self) -> int:
        """Number of missing forecasts."""
        lost = self.lost + self.context_missing
        return self.statuses.get("MISSING", 0) + self.statuses.get("INVALID", 0) + lost

    def figure(self, name: str) -> float:
        """Return a metric, or a measure of the context (see ``subset_figure``); NaN where it is unknown."""
        measure, _, subset = name.partition(_SUBSET)
        measured = self.context.get(subset or ALL, {}).get(measure)
        return self.metrics.get(name, math.nan) if measured is None else measured.value

    @property
    def fallbacks(self) -> int:
        """Number of pairs that another model forecast."""
        return self.statuses.get("FALLBACK", 0)

    def label(self, inputs: Protocol) -> str:
        """Return the model's name in tables, with its training protocol if it differs, and its fallbacks."""
        notes = [] if self.protocol in {"any", inputs.value} else [f"trained {self.protocol}"]
        if self.fallbacks:
            notes.append(f"{self.fallbacks} of {sum(self.statuses.values())} by a fallback")
        return f"{self.key} ({', '.join(notes)})" if notes else self.key


@dataclass(frozen=True, kw_only=True)
class BenchmarkResults(Results):
    """Results of a benchmark."""

    models: tuple[BenchmarkModelResult, ...]
    consistency: bool
    """True if forecasts for dispersion and convergence were requested."""
    seed: int
    plan: str
    """Digest of the requested forecasts and their data."""
    endpoint: str
    concurrency: int
    """Number of concurrent calls of the last replay; 0: unknown."""
    version: str
    """Version of this program."""
    refusals: tuple[str, ...] = field(default=())
    """Calls that the endpoint refused, in words."""
    context: ContextRun | None = None
    """None: the use of the context was not measured."""
    explanation: ExplanationRun | None = None
    """None: no forecasts were explained."""

    def statement(self) -> str:
        """Return what the figures are computed on, in words; every table carries it."""
        return f"{super().statement()}, seed {self.seed}"

    @property
    def context_settings(self) -> tuple[str, int, int] | None:
        """Model without context, number of donors, and the seed that chooses these, on which the measures of
        the context depend; None: they were not measured."""
        return None if self.context is None else (self.context.no_context, self.context.donors, self.seed)

    @property
    def missing(self) -> int:
        """Number of missing forecasts of all models."""
        return sum(model.missing for model in self.models)

    @classmethod
    def read(cls, folder: Path) -> "BenchmarkResults":
        """Read the ``results.json`` of a benchmark.

        Raises:
            BenchmarkError: the file is missing or invalid.
        """
        file = folder / RESULTS_FILE
        try:
            return TypeAdapter(cls).validate_python(_with_nan(json.loads(file.read_text(encoding="utf-8"))))
        except OSError as error:
            raise BenchmarkError(f"{file}: cannot be read: {error.strerror}") from error
        except (ValueError, AttributeError, TypeError, ValidationError) as error:
            raise BenchmarkError(f"{file}: not a benchmark's results: {error}") from error


@dataclass(frozen=True)
class Instances:
    """Figures of each pair of a run."""

    figures: Mapping[str, Floats]
    """[pairs] by ``<name@version>/<figure>``, NaN where missing; see ``PER_INSTANCE``."""
    scenes: Ints | None = None
    """[pairs], index of each pair's scene; None in files of older versions."""
    ratios: Mapping[str, Ratio] = field(default_factory=dict)
    """Figures as ratios of sums over the scenes by ``<name@version>/<figure>``, for those that are no means
    over pairs (``evaluate.CONSISTENCY``, measures of the context), or that are kept in no other form."""

    def ratio(self, model: str, figure: str) -> Ratio | None:
        """Return a figure as a ratio of sums over the scenes; None: the run does not hold it so.

        Args:
            model: ``name@version``.
            figure: name of a metric or of a measure of the context.
        """
        if (ratio := self.ratios.get(f"{model}/{figure}")) is not None:
            return ratio
        if self.scenes is None:
            return None
        if figure in HARDEST_FDE:
            return self._hardest(model, HARDEST_FDE[figure], self.scenes)
        values = self.figures.get(f"{model}/{figure}")
        return None if values is None else Ratio.of(values, np.ones(len(values)), self.scenes)

    def by_scenes(self, models: Sequence[str], figures: Sequence[str]) -> "Instances":
        """Return these figures over scenes alone, which take much less room than those of pairs.

        Args:
            models: ``name@version`` of each.
            figures: names of metrics or of measures of the context.
        """
        ratios = {f"{model}/{figure}": self.ratio(model, figure) for model in models for figure in figures}
        return Instances({}, None, {name: ratio for name, ratio in ratios.items() if ratio is not None})

    def mismatch_m(self) -> Floats | None:
        """Return the FDE at 6 s of the newest Kalman filter, which ranks the hard cases: [pairs], m; None: it
        was not evaluated."""
        models = {name.removesuffix(f"/{FDE}") for name in self.figures if name.endswith(f"/{FDE}")}
        kalman = [model for model in oldest_first(models) if model.partition("@")[0] == KALMAN]
        return self.figures[f"{kalman[-1]}/{FDE}"] if kalman else None

    def write(self, folder: Path) -> None:
        """Write ``instances.npz``.

        Raises:
            OSError: the file cannot be written.
        """
        arrays: dict[str, Any] = dict(self.figures)
        arrays |= {
            f"{_SCENE_SUMS}{name}": np.stack([ratio.sums, ratio.divisors], axis=1)
            for name, ratio in self.ratios.items()
        }
        if self.scenes is not None:
            arrays[_SCENES] = self.scenes
        with replacing(folder / INSTANCES_FILE) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def read(cls, folder: Path, pairs: int) -> "Instances":
        """Read ``instances.npz``; without such a file, there are no figures.

        Args:
            folder: folder of a run.
            pairs: number of pairs of the run.

        Raises:
            BenchmarkError: the file is damaged, or holds another number of pairs.
        """
        file = folder / INSTANCES_FILE
        if not file.is_file():
            return cls({})
        try:
            with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
                found = {name: arrays[name] for name in arrays.files}
        except (OSError, ValueError, BadZipFile) as error:
            raise BenchmarkError(f"{file}: cannot be read: {error}") from error
        scene_sums = {
            name.removeprefix(_SCENE_SUMS): found.pop(name)
            for name in list(found)
            if name.startswith(_SCENE_SUMS)
        }
        rows = {sums.shape for sums in scene_sums.values()}
        if len(rows) > 1 or any(len(shape) != 2 or shape[1] != 2 for shape in rows):
            raise BenchmarkError(f"{file}: figures by scenes are of {sorted(rows)}")
        for name, values in found.items():
            if values.shape != (pairs,):
                raise BenchmarkError(f"{file}: {name} is of {list(values.shape)}, not of {pairs} pairs")
        scenes = found.pop(_SCENES, None)
        return cls(found, scenes, {name: Ratio(*sums.T) for name, sums in scene_sums.items()})

    def _hardest(self, model: str, share: float, scenes: Ints) -> Ratio | None:
        fde_m, mismatch_m = self.figures.get(f"{model}/{FDE}"), self.mismatch_m()
        if fde_m is None or mismatch_m is None or not np.isfinite(mismatch_m).any():
            return None
        members = hardest_of_known(mismatch_m, share)
        return Ratio.of(np.where(members, fde_m, 0.0), members.astype(np.float64), scenes)


def _with_nan(document: Any) -> Any:
    """Return the document with null metrics as NaN."""
    for model in document.get("models", []):
        model["metrics"] = _known(model.get("metrics", {}))
        for measures in model.get("context", {}).values():
            measures.update({name: _known(one) for name, one in measures.items()})
        explanation = model.get("explanation", {})
        explanation.update({part: _known(one) for part, one in explanation.items()})
    return document


def _known(figures: Mapping[str, Any]) -> dict[str, Any]:
    return {name: math.nan if value is None else value for name, value in figures.items()}
