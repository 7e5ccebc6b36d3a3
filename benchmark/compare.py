"""Two runs beside each other: what differs between them, and whether the difference is more than noise."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark import BenchmarkError
from benchmark.results import INSTANCES_FILE, PER_INSTANCE, ModelResult, Results, read_instances
from model.arrays import Floats
from model.evaluation.text_tables import Table, document, number, signed

KEY_FIGURES = {
    "ADE-ML 6 s": "ade_ml_6s_m",
    "FDE-ML 6 s": "fde_ml_6s_m",
    "OffR-ML": "off_road_ml",
    "FDE-f 6 s": "fde_f_6s_m",
    "minADE_5": "min_ade_5_m",
    "minADE_10": "min_ade_10_m",
    "merged minADE_5": "merged_min_ade_5_m",
    "merged brier-minFDE_5": "merged_brier_min_fde_5_m",
    "NLL": "nll",
    "D, std": "dispersion_std_m",
    "C(1 m)": "convergence_1m_s",
    "FDE, hardest 3 %": "fde_hardest_3_m",
}
CLEAR = 2.0
"""Standard errors that a difference must exceed to be called clear."""

_SETTINGS = (
    "protocol",
    "data",
    "split",
    "pairs",
    "limit",
    "consistency",
    "samples",
    "draws",
    "seed",
    "plan",
    "concurrency",
)
_DIGEST_SHOWN = 12


@dataclass(frozen=True)
class Difference:
    """One figure of one model in both runs."""

    figure: str
    a: float
    b: float
    difference: float
    """B − A; where there are pairs, its mean over those that both have."""
    standard_error: float
    """Of that mean; NaN where the pairs cannot be compared one by one."""
    pairs: int
    """How many both have; 0: not compared one by one."""

    @property
    def clear(self) -> bool | None:
        """Whether it is more than noise; None: unknown."""
        if math.isnan(self.standard_error) or math.isnan(self.difference):
            return None
        return abs(self.difference) > CLEAR * self.standard_error


@dataclass(frozen=True)
class ComparedModel:
    """A model that is in both runs."""

    a: str
    """Its ``name@version`` there."""
    b: str
    differences: tuple[Difference, ...]

    @property
    def label(self) -> str:
        """Its ``name@version``, or both of them."""
        return self.a if self.a == self.b else f"{self.a} → {self.b}"


@dataclass(frozen=True)
class Comparison:
    """Of run B with run A."""

    a: Path
    b: Path
    remarks: tuple[str, ...]
    """What differs between the runs besides figures, in words."""
    models: tuple[ComparedModel, ...]
    only_a: tuple[str, ...]
    """``name@version`` of models that B has no counterpart of."""
    only_b: tuple[str, ...]


def compare(a: Path, b: Path) -> Comparison:
    """Compares two runs.

    A model of A is compared with that of the same ``name@version`` in B; of what is left then, with the one
    of the same name, if each run has just one.

    Args:
        a: folder of a run.
        b: folder of another one.

    Raises:
        BenchmarkError: one holds no results, or damaged ones; names the file.
    """
    results = (Results.read(a), Results.read(b))
    instances, unpaired = _paired_instances((a, b), results)
    matches = list(_matches(*results))
    return Comparison(
        a,
        b,
        remarks=(*_settings(*results), *_models(matches), *unpaired),
        models=tuple(
            ComparedModel(one.key, other.key, _differences(one, other, *instances)) for one, other in matches
        ),
        only_a=_unmatched(results[0], {one.key for one, _ in matches}),
        only_b=_unmatched(results[1], {other.key for _, other in matches}),
    )


def markdown(comparison: Comparison) -> str:
    """As a document: what is to be known first, then the differences."""
    lines = [f"A: {comparison.a}", f"B: {comparison.b}", *comparison.remarks]
    for run, names in (("A", comparison.only_a), ("B", comparison.only_b)):
        if names:
            lines.append(f"only in {run}: {', '.join(names)}")
    tables = [table(comparison)] if comparison.models else []
    return document("Comparison of two benchmarks", tables, lines)


def table(comparison: Comparison) -> Table:
    """All differences."""
    rows = tuple(_row(model, one) for model in comparison.models for one in model.differences)
    note = (
        "B − A; where pairs can be compared one by one, over those that both runs have, with the standard "
        f"error of its mean; clear: more than {CLEAR:g} standard errors. Pairs of one agent are alike, so "
        "the true error is somewhat greater."
    )
    columns = ("model", "figure", "A", "B", "B − A", "standard error", "pairs", "clear")
    return Table("Differences", note, columns, rows)


def _matches(a: Results, b: Results) -> Iterator[tuple[ModelResult, ModelResult]]:
    """In A's order."""
    same = {model.key: model for model in b.models if model.key in {one.key for one in a.models}}
    for one in a.models:
        if one.key in same:
            yield one, same[one.key]
            continue
        rivals, others = (
            [model for model in results.models if model.name == one.name and model.key not in same]
            for results in (a, b)
        )
        if len(rivals) == len(others) == 1:
            yield one, others[0]


def _unmatched(results: Results, matched: set[str]) -> tuple[str, ...]:
    return tuple(model.key for model in results.models if model.key not in matched)


def _settings(a: Results, b: Results) -> Iterator[str]:
    """What was asked differently, and by what."""
    for name in (*_SETTINGS, "endpoint", "version"):
        values = [getattr(results, name) for results in (a, b)]
        if values[0] == values[1]:
            continue
        if name == "plan":
            digests = [digest[:_DIGEST_SHOWN] for digest in values]
            yield f"the plans differ (other pairs, calls or data): {digests[0]} in A, {digests[1]} in B"
        else:
            word = "program's version" if name == "version" else name
            yield f"{word}: {_word(values[0])} in A, {_word(values[1])} in B"


def _word(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)


def _models(matches: Sequence[tuple[ModelResult, ModelResult]]) -> Iterator[str]:
    """What differs about models that are in both."""
    for one, other in matches:
        facts = {
            "version": (one.version, other.version),
            "trained by protocol": (one.protocol, other.protocol),
            "trained on": (one.trained_on, other.trained_on),
            "pairs without a forecast": (one.missing, other.missing),
        }
        for fact, (was, now) in facts.items():
            if was != now:
                yield f"{one.name}, {fact}: {was} in A, {now} in B"


_Instances = Mapping[str, Floats]


def _paired_instances(
    folders: tuple[Path, Path], results: tuple[Results, Results]
) -> tuple[tuple[_Instances, _Instances], list[str]]:
    """Figures of each pair, by ``<name@version>/<figure>`` [pairs], and why there are none."""
    none: tuple[_Instances, _Instances] = ({}, {})
    if results[0].plan != results[1].plan or results[0].pairs != results[1].pairs:
        return none, ["the runs are of other pairs or plans: no comparison pair by pair"]
    found = (_instances(folders[0], results[0]), _instances(folders[1], results[1]))
    lacking = [run for run, instances in zip("AB", found, strict=True) if not instances]
    if lacking:
        return none, [f"no figures of each pair in {' and '.join(lacking)}: no comparison pair by pair"]
    return found, []


def _instances(folder: Path, results: Results) -> _Instances:
    found = read_instances(folder)
    for name, values in found.items():
        if values.shape != (results.pairs,):
            raise BenchmarkError(
                f"{folder / INSTANCES_FILE}: {name} is of {list(values.shape)}, not of {results.pairs} pairs"
            )
    return found


def _differences(
    one: ModelResult, other: ModelResult, a: _Instances, b: _Instances
) -> tuple[Difference, ...]:
    """Of all figures that one of them has at least."""
    found = []
    for figure, name in KEY_FIGURES.items():
        was, now = (model.metrics.get(name, math.nan) for model in (one, other))
        if math.isnan(was) and math.isnan(now):
            continue
        keys = f"{one.key}/{name}", f"{other.key}/{name}"
        if name in PER_INSTANCE and keys[0] in a and keys[1] in b:
            found.append(Difference(figure, was, now, *_mean_difference(a[keys[0]], b[keys[1]])))
        else:
            found.append(Difference(figure, was, now, now - was, math.nan, 0))
    return tuple(found)


def _mean_difference(a: Floats, b: Floats) -> tuple[float, float, int]:
    """Mean of B − A, its standard error, and over how many: a, b [N], NaN where missing."""
    both = np.isfinite(a) & np.isfinite(b)
    apart = b[both] - a[both]
    count = len(apart)
    mean = float(apart.mean()) if count else math.nan
    error = float(apart.std(ddof=1)) / math.sqrt(count) if count > 1 else math.nan
    return mean, error, count


def _row(model: ComparedModel, one: Difference) -> tuple[str, ...]:
    clear = {True: "yes", False: "no", None: "unknown"}[one.clear]
    return (
        model.label,
        one.figure,
        number(one.a, 3),
        number(one.b, 3),
        signed(one.difference, 3),
        number(one.standard_error, 3),
        number(one.pairs),
        clear,
    )
