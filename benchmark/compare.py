"""Comparison of two runs, with the uncertainty of the differences.

If both runs hold figures of the same pairs, a difference is the mean over the pairs that both have. Its 95 %
interval is by bootstrap over scenes (``benchmark.bootstrap``).
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark.bootstrap import LEVEL, RESAMPLES, SEED, difference_interval, mean_interval
from benchmark.results import (
    ALL,
    FDE,
    HARDEST,
    HARDEST_FDE,
    TURNS,
    BenchmarkModelResult,
    BenchmarkResults,
    Instances,
    subset_figure,
)
from model.arrays import Floats, Ints
from model.evaluation.tables import UNKNOWN, Table, document, number, signed
from model.metrics.consistency import RANGES_M

CONTEXT_FIGURES = {
    subset_figure(heading, subset): subset_figure(measure, subset)
    for heading, measure in (
        ("Gain", "gain_m"),
        ("map advantage", "map_advantage_m"),
        ("neighbours advantage", "neighbors_advantage_m"),
        ("compliance", "compliance"),
    )
    for subset in (ALL, HARDEST, TURNS)
}
"""Measures of the context, by their names in tables."""
KEY_FIGURES = {
    "ADE-ML 6 s": "ade_ml_6s_m",
    "FDE-ML 6 s": FDE,
    "merged FDE 6 s": "fde_merged_6s_m",
    "OffR-ML": "off_road_ml",
    "FDE-f 6 s": "fde_f_6s_m",
    "minADE_5": "min_ade_5_m",
    "minADE_10": "min_ade_10_m",
    "merged minADE_5": "merged_min_ade_5_m",
    "merged brier-minFDE_5": "merged_brier_min_fde_5_m",
    "NLL": "nll",
    "D, std": "dispersion_std_m",
    **{f"C({range_m:g} m)": f"convergence_{range_m:g}m_s" for range_m in RANGES_M},
    **{f"FDE, hardest {100 * share:g} %": name for name, share in HARDEST_FDE.items()},
    **CONTEXT_FIGURES,
}
"""Metrics and measures of the context, by their names in tables."""
CLEAR = 2.0
"""Standard errors that a clear difference exceeds."""

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
    """Difference of one figure of one model between the runs."""

    figure: str
    a: float
    b: float
    difference: float
    """B − A; in a paired comparison, its mean over the pairs that both runs have."""
    standard_error: float
    """Standard error of that mean as if pairs were independent; NaN without a paired comparison, and for
    figures that are not means over all pairs."""
    pairs: int
    """Number of compared pairs; 0: no paired comparison."""
    interval: tuple[float, float] = (math.nan, math.nan)
    """95 % interval of the difference by bootstrap over scenes; NaN where the scenes are unknown or fewer
    than two."""

    @property
    def clear(self) -> bool | None:
        """True if the difference exceeds two standard errors and its interval, if known, excludes 0; None:
        unknown."""
        if math.isnan(self.standard_error) or math.isnan(self.difference):
            return None
        low, high = self.interval
        return abs(self.difference) > CLEAR * self.standard_error and not low <= 0 <= high


@dataclass(frozen=True)
class ComparedModel:
    """A model that is in both runs."""

    a: str
    """``name@version`` in A."""
    b: str
    """``name@version`` in B."""
    differences: tuple[Difference, ...]

    @property
    def label(self) -> str:
        """``name@version``, or both of them."""
        return self.a if self.a == self.b else f"{self.a} → {self.b}"


@dataclass(frozen=True)
class Comparison:
    """Comparison of run B with run A."""

    a: Path
    b: Path
    remarks: tuple[str, ...]
    """Differences between the runs besides figures, in words."""
    models: tuple[ComparedModel, ...]
    only_a: tuple[str, ...]
    """``name@version`` of models without a counterpart in B."""
    only_b: tuple[str, ...]


def compare(a: Path, b: Path) -> Comparison:
    """Compare two runs.

    A model of A is compared with the model of the same ``name@version`` in B; the remaining ones with the
    model of the same name, if each run has just one.

    Args:
        a: folder of a run.
        b: folder of another run.

    Raises:
        BenchmarkError: a folder has no results, or damaged ones; the text names the file.
    """
    results = (BenchmarkResults.read(a), BenchmarkResults.read(b))
    instances, unpaired = _paired_instances((a, b), results)
    matches = list(_matches(*results))
    figures, left_out = _compared_figures(*results)
    return Comparison(
        a,
        b,
        remarks=(*_settings(*results), *_models(matches), *unpaired, *left_out),
        models=tuple(
            ComparedModel(one.key, other.key, _differences(one, other, *instances, figures))
            for one, other in matches
        ),
        only_a=_unmatched(results[0], {one.key for one, _ in matches}),
        only_b=_unmatched(results[1], {other.key for _, other in matches}),
    )


def markdown(comparison: Comparison) -> str:
    """Return the comparison as a document: remarks first, then the differences."""
    lines = [f"A: {comparison.a}", f"B: {comparison.b}", *comparison.remarks]
    for run, names in (("A", comparison.only_a), ("B", comparison.only_b)):
        if names:
            lines.append(f"only in {run}: {', '.join(names)}")
    tables = [table(comparison)] if comparison.models else []
    return document("Comparison of two benchmarks", tables, lines)


def table(comparison: Comparison) -> Table:
    """Return all differences as a table."""
    rows = tuple(_row(model, one) for model in comparison.models for one in model.differences)
    note = (
        "B − A; in a paired comparison, the mean over the pairs of both runs, with its standard error as if "
        f"pairs were independent. {100 * LEVEL:g} % intervals are by bootstrap over scenes ({RESAMPLES} "
        f"resamples, seed {SEED}), where both runs hold the figure by scenes; which pairs are the hardest is "
        f"not drawn again. Clear: more than {CLEAR:g} standard errors, and an interval without 0."
    )
    columns = ("model", "figure", "A", "B", "B − A", "standard error", "95 % interval", "pairs", "clear")
    return Table("Differences", note, columns, rows)


def _matches(
    a: BenchmarkResults, b: BenchmarkResults
) -> Iterator[tuple[BenchmarkModelResult, BenchmarkModelResult]]:
    """Yield the compared models in A's order."""
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


def _unmatched(results: BenchmarkResults, matched: set[str]) -> tuple[str, ...]:
    return tuple(model.key for model in results.models if model.key not in matched)


def _settings(a: BenchmarkResults, b: BenchmarkResults) -> Iterator[str]:
    """Yield the differing settings of the runs."""
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


def _models(matches: Sequence[tuple[BenchmarkModelResult, BenchmarkModelResult]]) -> Iterator[str]:
    """Yield the differences of models in both runs."""
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


def _paired_instances(
    folders: tuple[Path, Path], results: tuple[BenchmarkResults, BenchmarkResults]
) -> tuple[tuple[Instances, Instances], list[str]]:
    """Return the figures of each pair in both runs, and why there are none."""
    none = (Instances({}), Instances({}))
    if results[0].plan != results[1].plan or results[0].pairs != results[1].pairs:
        return none, ["the runs are of other pairs or plans: no paired comparison"]
    a, b = (Instances.read(folder, one.pairs) for folder, one in zip(folders, results, strict=True))
    lacking = [
        run
        for run, instances in zip("AB", (a, b), strict=True)
        if not (instances.figures or instances.ratios)
    ]
    if lacking:
        return none, [f"no figures of each pair in {' and '.join(lacking)}: no paired comparison"]
    return (a, b), []


def _compared_figures(a: BenchmarkResults, b: BenchmarkResults) -> tuple[Mapping[str, str], list[str]]:
    """Return the figures that can be compared, and why others cannot."""
    measured = [one.context_settings for one in (a, b)]
    if None in measured or measured[0] == measured[1]:
        return KEY_FIGURES, []
    settings = " and ".join(
        f"{one[0]}, {one[1]} donors and seed {one[2]} in {run}"
        for run, one in zip("AB", measured, strict=True)
        if one is not None
    )
    kept = {heading: name for heading, name in KEY_FIGURES.items() if heading not in CONTEXT_FIGURES}
    return kept, [f"measures of the context are not compared: by {settings}"]


def _differences(
    one: BenchmarkModelResult,
    other: BenchmarkModelResult,
    a: Instances,
    b: Instances,
    figures: Mapping[str, str],
) -> tuple[Difference, ...]:
    """Return the differences of all figures that at least one of the models has."""
    scenes = b.scenes if a.scenes is None else a.scenes  # the plans are equal, and so are the scenes
    found = []
    for figure, name in figures.items():
        was, now = one.figure(name), other.figure(name)
        if math.isnan(was) and math.isnan(now):
            continue
        pairs = a.figures.get(f"{one.key}/{name}"), b.figures.get(f"{other.key}/{name}")
        if pairs[0] is not None and pairs[1] is not None:
            found.append(_paired_difference(figure, was, now, pairs[0], pairs[1], scenes))
            continue
        ratios = a.ratio(one.key, name), b.ratio(other.key, name)
        interval = (math.nan, math.nan)
        if ratios[0] is not None and ratios[1] is not None:
            interval = difference_interval([ratios[0]], [ratios[1]])
        found.append(Difference(figure, was, now, now - was, math.nan, 0, interval))
    return tuple(found)


def _paired_difference(
    figure: str, was: float, now: float, a: Floats, b: Floats, scenes: Ints | None
) -> Difference:
    """Return the mean of B − A with its uncertainty.

    Args:
        figure: name of the figure.
        was: mean of the figure in A.
        now: mean of the figure in B.
        a: [N], the figure of each pair in A; NaN where missing.
        b: [N], likewise in B.
        scenes: [N], index of each pair's scene; None: unknown.
    """
    both = np.isfinite(a) & np.isfinite(b)
    differences = b[both] - a[both]
    count = len(differences)
    mean = float(differences.mean()) if count else math.nan
    error = float(differences.std(ddof=1)) / math.sqrt(count) if count > 1 else math.nan
    interval = (math.nan, math.nan) if scenes is None else mean_interval(differences, scenes[both])
    return Difference(figure, was, now, mean, error, count, interval)


def _row(model: ComparedModel, one: Difference) -> tuple[str, ...]:
    clear = {True: "yes", False: "no", None: "unknown"}[one.clear]
    return (
        model.label,
        one.figure,
        number(one.a, 3),
        number(one.b, 3),
        signed(one.difference, 3),
        number(one.standard_error, 3),
        bounds(one.interval),
        number(one.pairs),
        clear,
    )


def bounds(interval: tuple[float, float]) -> str:
    """Return an interval of differences as text."""
    low, high = (signed(bound, 3) for bound in interval)
    return UNKNOWN if math.isnan(interval[0]) else f"{low} … {high}"
