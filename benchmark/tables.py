"""A benchmark's results as tables of text."""

import math
from collections.abc import Callable, Mapping

from benchmark.results import Latency, ModelResult, Results
from model.evaluation.published import (
    PUBLISHED,
    PUBLISHED_CONSISTENCY,
    PUBLISHED_HARD_CASES,
    Published,
    PublishedConsistency,
    PublishedHardCases,
)
from model.evaluation.tables import MERGED, MERGED_NOTE, STOOD_NOTE, WITHOUT_STANDING
from model.evaluation.text_tables import Table, document, metrics_table, number, signed
from model.forecaster import Protocol
from model.metrics.consistency import RANGES_M
from model.metrics.displacement import HORIZONS_S
from model.metrics.hard import HARD_SHARES
from model.metrics.multimodal import MISS_TOLERANCE_M, TOP_K

DISPLACEMENT = {
    **{f"ADE {second} s": f"ade_ml_{second}s_m" for second in HORIZONS_S},
    **{f"FDE {second} s": f"fde_ml_{second}s_m" for second in HORIZONS_S},
    "OffR": "off_road_ml",
    "ADE-f": "ade_f_6s_m",
    "FDE-f": "fde_f_6s_m",
    "OffR-f": "off_road_f",
}
CONSISTENCY = {
    "D, std": "dispersion_std_m",
    "D, mean": "dispersion_mean_m",
    "D, rms": "dispersion_rms_m",
    **{f"C({range_m:g} m)": f"convergence_{range_m:g}m_s" for range_m in RANGES_M},
}
HARD_CASES = {
    **{f"hardest {round(100 * share)} %": f"fde_hardest_{round(100 * share)}_m" for share in HARD_SHARES},
    "all": "fde_hardest_all_m",
}
_LOST = "lost elsewhere"
_STATUSES = ("OK", "SHORT_HISTORY", "FALLBACK", "INVALID", "MISSING")

_THEIRS = "Ben-Younes et al. 2022"
_Made = Table | str
"""A table, or why there is none."""


def tables(results: Results) -> list[Table]:
    """Those that have something to say."""
    return [made for made in _all(results) if isinstance(made, Table)]


def left_out(results: Results) -> list[str]:
    """Of every table that would be empty, why."""
    return [made for made in _all(results) if isinstance(made, str)]


def markdown(results: Results) -> str:
    """All tables, each with what it is of; first, why some are not there."""
    return document(f"Benchmark: {results.statement()}", tables(results), left_out(results))


def label(model: ModelResult, inputs: Protocol) -> str:
    """``name@version``; what it was trained on where that is not what it got; how many pairs another model
    forecast in its place."""
    notes = [] if model.protocol in {"any", inputs.value} else [f"trained {model.protocol}"]
    if model.fallbacks:
        notes.append(f"{model.fallbacks} of {sum(model.statuses.values())} by a fallback")
    return f"{model.key} ({', '.join(notes)})" if notes else model.key


def _all(results: Results) -> list[_Made]:
    return [
        _displacement(results),
        _consistency(results),
        _hard_cases(results),
        _multimodal(results),
        _merged(results),
        _moving(results),
        _likelihood(results),
        _latency(results),
        _beside(results, 1, DISPLACEMENT, PUBLISHED),
        _beside(results, 2, CONSISTENCY, PUBLISHED_CONSISTENCY),
        _beside(results, 3, HARD_CASES, PUBLISHED_HARD_CASES),
        _outcomes(results),
    ]


def _displacement(results: Results) -> _Made:
    sampled = (
        f"f: mean over {results.samples} sampled trajectories a pair, at 6 s"
        if results.samples
        else "f: no trajectories were sampled"
    )
    note = (
        f"{results.statement()}. ADE and FDE of the most likely trajectory, m; OffR: share of these that "
        f"leave the driveable area; {sampled}."
    )
    return _metrics(results, "1. Displacement and driveable area", note, DISPLACEMENT, "no forecasts")


def _consistency(results: Results) -> _Made:
    note = (
        f"{results.statement()}. Means over the instants that have a forecast of every age, 0.5 … 6 s. D, m: "
        "spread of these forecasts about their barycentre, as standard deviation of the distances (the "
        "paper's formula), mean distance and root mean square. C(τ), s: for how long before the instant all "
        "forecasts were within τ of the truth."
    )
    why = (
        "there is no instant with a forecast of every age"
        if results.consistency
        else "dispersion and convergence were not asked for"
    )
    columns = {**CONSISTENCY, "instants": "instants"}
    return _metrics(
        results,
        "2. Dispersion and convergence",
        note,
        columns,
        why,
        lambda model: {**model.metrics, "instants": model.instants or math.nan},
    )


def _hard_cases(results: Results) -> _Made:
    note = (
        f"{results.statement()}. FDE of the most likely trajectory at 6 s, m, on the pairs that the (newest) "
        "Kalman filter mistakes most, and on all that it ranks."
    )
    return _metrics(
        results,
        "3. Hard cases",
        note,
        HARD_CASES,
        "kalman, whose mistakes rank the pairs, was not among the models",
        lambda model: model.metrics if _known(model.metrics, "fde_hardest_1_m") else {},
    )


def _multimodal(results: Results) -> _Made:
    columns = {f"minADE_{k}": f"min_ade_{k}_m" for k in TOP_K}
    columns |= {f"minFDE_{k}": f"min_fde_{k}_m" for k in TOP_K}
    columns |= {f"miss rate {k}": f"miss_rate_{k}" for k in TOP_K}
    note = (
        f"{results.statement()}. The best of the k likeliest modes as the model has them, at 6 s, m; miss: "
        f"every one of them is {MISS_TOLERANCE_M:g} m off somewhere."
    )
    return _metrics(results, "4. Raw modes", note, columns, "no forecasts")


def _merged(results: Results) -> _Made:
    note = (
        f"{results.statement()}. Modes that a planner would not tell apart merged into one, weights summed; "
        f"{MERGED_NOTE}"
    )
    return _metrics(results, "4.1 Merged modes", note, MERGED, "no forecasts of a version that merges modes")


def _moving(results: Results) -> _Made:
    note = (
        f"{results.statement()}. The main figures without the pairs whose agent stood before now: "
        f"{STOOD_NOTE} Raw: the model's own modes; merged: as in table 4.1."
    )
    return _metrics(
        results, "4.2 Without those that stood", note, WITHOUT_STANDING, "no figures without them"
    )


def _likelihood(results: Results) -> _Made:
    columns = {"NLL": "nll", "NLL 1 s": "nll_1s", "NLL 3 s": "nll_3s", "NLL 6 s": "nll_6s"}
    columns |= {f"inside {percent} %": f"inside_{percent}" for percent in (50, 90, 99)}
    drawn = f"by {results.draws} draws a step" if results.draws else "not computed"
    note = (
        f"{results.statement()}. NLL: nats, mean over the steps, and at one; inside p %: share of the steps "
        f"at which the truth is in the region that is said to hold p % ({drawn})."
    )
    return _metrics(results, "5. Likelihood and calibration", note, columns, "no forecasts", digits=3)


def _latency(results: Results) -> _Made:
    columns = {
        "calls": "calls",
        "p50": "p50_s",
        "p90": "p90_s",
        "p99": "p99_s",
        "queue p50": "queue_p50_s",
        "inference p50": "inference_p50_s",
        "mean batch": "batch_agents_mean",
    }
    note = (
        f"{results.statement()}. ms that the client waited for a call, retries included"
        + (f", {results.concurrency} on their way at once" if results.concurrency else "")
        + "; of these, by the server's account, in its queue and in the model; agents in the batch that a "
        "call rode in."
    )
    return _metrics(
        results,
        "6. Latency",
        note,
        columns,
        "no calls were timed",
        lambda model: _milliseconds(model.latency) if model.latency else {},
        digits=1,
    )


def _milliseconds(latency: Latency) -> dict[str, float]:
    times = ("p50_s", "p90_s", "p99_s", "queue_p50_s", "inference_p50_s")
    found: dict[str, float] = {name: 1000 * getattr(latency, name) for name in times}
    return found | {"calls": latency.calls, "batch_agents_mean": latency.batch_agents_mean}


def _beside(
    results: Results,
    table: int,
    columns: Mapping[str, str],
    published: Mapping[str, Published | PublishedConsistency | PublishedHardCases],
) -> _Made:
    """Three rows a model: ours, the paper's, and by how much ours is greater."""
    title = f"7.{table} Beside the paper's table {table}"
    both = []
    for model in results.models:
        if model.name in published:
            theirs = published[model.name].figures()
            if any(_known(model.metrics, name) for name in theirs):
                both.append((model, theirs))
    if not both:
        return f"{title}: left out: no model here has a figure of it"
    shown = {heading: name for heading, name in columns.items() if any(name in theirs for _, theirs in both)}
    rows = []
    for model, theirs in both:
        ours = [model.metrics.get(name, math.nan) for name in shown.values()]
        paper = [theirs.get(name, math.nan) for name in shown.values()]
        apart = [signed(our - their) for our, their in zip(ours, paper, strict=True)]
        name = label(model, results.protocol)
        rows += [
            (name, "ours", *map(number, ours)),
            (name, "paper", *map(number, paper)),
            (name, "ours − paper", *apart),
        ]
    note = (
        f"Ours: {results.statement()}. Paper: {_THEIRS}, table {table}: paper protocol, its own split, "
        "2000 sampled trajectories."
    )
    if "dispersion_std_m" in shown.values():
        note += (
            " The paper has one D: its formula is that of the standard deviation, its figures fit the mean "
            "distance better, so it stands beside both."
        )
    return Table(title, note, ("model", "whose", *shown), tuple(rows))


def _outcomes(results: Results) -> _Made:
    found = {status for model in results.models for status in model.statuses}
    columns = [*_STATUSES, *sorted(found - {*_STATUSES})]
    note = (
        f"{results.statement()}. Pairs by how their forecast came out; SHORT_HISTORY: from fewer frames than "
        "the model uses at most; FALLBACK: by another model; MISSING: no answer. Lost elsewhere: forecasts "
        "for dispersion and convergence alone that did not come. Calls that were refused: "
        f"{len(results.refusals)}."
    )
    return _metrics(
        results,
        "8. How pairs came out",
        note,
        {column: column for column in [*columns, _LOST]},
        "no pairs",
        lambda model: (
            {status: model.statuses.get(status, 0) for status in columns} | {_LOST: model.lost}
            if model.statuses
            else {}
        ),
    )


def _metrics(
    results: Results,
    title: str,
    note: str,
    columns: Mapping[str, str],
    why_empty: str,
    figures: Callable[[ModelResult], Mapping[str, float]] = lambda model: model.metrics,
    digits: int = 2,
) -> _Made:
    """A row a model that has any of the figures."""
    rows = [(label(model, results.protocol), figures(model)) for model in results.models]
    telling = [row for row in rows if any(_known(row[1], name) for name in columns.values())]
    if not telling:
        return f"{title}: left out: {why_empty}"
    return metrics_table(title, note, columns, telling, digits)


def _known(figures: Mapping[str, float], name: str) -> bool:
    return not math.isnan(figures.get(name, math.nan))
