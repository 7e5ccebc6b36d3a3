"""Tables of a benchmark: those shared with the evaluation, and those that only a benchmark has."""

import math

from benchmark.results import BenchmarkResults, Estimate, Latency
from cab_forecast.explanations import PARTS
from model.evaluation.published import PUBLISHED, PUBLISHED_CONSISTENCY, PUBLISHED_HARD_CASES
from model.evaluation.tables import (
    DISPLACEMENT,
    UNKNOWN,
    Table,
    displacement_table,
    document,
    is_known,
    likelihood_table,
    merged_modes_table,
    metrics_table,
    moving_table,
    number,
    paper_table,
    raw_modes_table,
    signed,
)
from model.metrics.consistency import RANGES_M
from model.metrics.hard import HARD_SHARES

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
CONTEXT = {
    "Gain": "gain_m",
    "map": "map_advantage_m",
    "neighbours": "neighbors_advantage_m",
    "control": "map_control_m",
    "control, size": "map_control_size_m",
    "compliance": "compliance",
}
_UNSIGNED = {"map_control_size_m", "compliance"}
_LOST = "lost elsewhere"
_STATUSES = ("OK", "SHORT_HISTORY", "FALLBACK", "INVALID", "MISSING")


def tables(results: BenchmarkResults) -> list[Table]:
    """Return the tables that are not empty."""
    return [made for made in _all(results) if isinstance(made, Table)]


def left_out(results: BenchmarkResults) -> list[str]:
    """Return, for each empty table, why it is left out."""
    return [made for made in _all(results) if isinstance(made, str)]


def markdown(results: BenchmarkResults) -> str:
    """Return all tables as one document, with the reasons for those left out."""
    return document(f"Benchmark: {results.statement()}", tables(results), left_out(results))


def _all(results: BenchmarkResults) -> list[Table | str]:
    return [
        displacement_table(results),
        _consistency(results),
        _hard_cases(results),
        raw_modes_table(results),
        merged_modes_table(results),
        moving_table(results),
        likelihood_table(results),
        _latency(results),
        paper_table(results, 1, DISPLACEMENT, PUBLISHED),
        paper_table(results, 2, CONSISTENCY, PUBLISHED_CONSISTENCY),
        paper_table(results, 3, HARD_CASES, PUBLISHED_HARD_CASES),
        _statuses(results),
        _context(results),
        _explanations(results),
    ]


def _consistency(results: BenchmarkResults) -> Table | str:
    note = (
        "Means over the instants that have a forecast of every age, 0.5 … 6 s. D, m: spread of these "
        "forecasts about their barycentre, as standard deviation of the distances (the paper's formula), "
        "mean distance and root mean square. C(τ), s: for how long before the instant all forecasts were "
        "within τ of the truth."
    )
    why = (
        "there is no instant with a forecast of every age"
        if results.consistency
        else "forecasts for dispersion and convergence were not requested"
    )
    return metrics_table(
        results,
        "2. Dispersion and convergence",
        note,
        {**CONSISTENCY, "instants": "instants"},
        why,
        [{**model.metrics, "instants": model.instants or math.nan} for model in results.models],
    )


def _hard_cases(results: BenchmarkResults) -> Table | str:
    note = (
        "FDE of the most likely trajectory at 6 s, m, on the pairs with the largest errors of the (newest) "
        "Kalman filter, and on all pairs that it forecasts."
    )
    figures = [
        model.metrics if is_known(model.metrics, "fde_hardest_1_m") else {} for model in results.models
    ]
    return metrics_table(
        results,
        "3. Hard cases",
        note,
        HARD_CASES,
        "kalman, whose errors rank the pairs, was not among the models",
        figures,
    )


def _latency(results: BenchmarkResults) -> Table | str:
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
        "Time that the client waited for a call, ms, retries included"
        + (f", {results.concurrency} concurrent calls" if results.concurrency else "")
        + "; part of it in the queue and in the model, as the server reports it; agents in the call's batch."
    )
    figures = [_milliseconds(model.latency) if model.latency else {} for model in results.models]
    return metrics_table(results, "6. Latency", note, columns, "no calls were timed", figures, digits=1)


def _milliseconds(latency: Latency) -> dict[str, float]:
    times = ("p50_s", "p90_s", "p99_s", "queue_p50_s", "inference_p50_s")
    found: dict[str, float] = {name: 1000 * getattr(latency, name) for name in times}
    return found | {"calls": latency.calls, "batch_agents_mean": latency.batch_agents_mean}


def _statuses(results: BenchmarkResults) -> Table | str:
    found = {status for model in results.models for status in model.statuses}
    columns = [*_STATUSES, *sorted(found - {*_STATUSES})]
    note = (
        "Pairs by the status of their forecast; SHORT_HISTORY: from fewer frames than the model uses at "
        "most; FALLBACK: by another model; MISSING: no response. Lost elsewhere: forecasts requested for "
        f"dispersion and convergence only that did not arrive. Refused calls: {len(results.refusals)}."
    )
    figures = [
        {status: model.statuses.get(status, 0) for status in columns} | {_LOST: model.lost}
        if model.statuses
        else {}
        for model in results.models
    ]
    return metrics_table(
        results,
        "8. Forecast statuses",
        note,
        {column: column for column in [*columns, _LOST]},
        "no pairs",
        figures,
    )


def _context(results: BenchmarkResults) -> Table | str:
    title = "9. Use of the context"
    if results.context is None:
        return f"{title}: left out: it was not measured (--context)"
    rows = tuple(
        (
            model.label(results.protocol),
            subset,
            str(max(one.pairs for one in measures.values())),
            *(_estimate(name, measures.get(name)) for name in CONTEXT.values()),
        )
        for model in results.models
        for subset, measures in model.context.items()
    )
    if not rows:
        return f"{title}: left out: no model has answers about it"
    run = results.context
    note = (
        f"{results.statement()}. In m, of FDE of the most likely trajectory at 6 s, with 95 % intervals by "
        f"bootstrap over scenes. Gain: FDE of {run.no_context} minus that of the model. Map, neighbours: FDE "
        f"with those of an agent of another scene (up to {run.donors} a pair) minus FDE with its own. "
        "Control: FDE with its own map, shifted by 0.2 m and turned by 1°, minus FDE; and the mean size of "
        f"that difference. Compliance: 1 − off-road rate on a donor's map / that of {run.no_context}. "
        f"{run.cases} forecasts of each learned model; {run.timed} of all took {run.seconds:.0f} s, which "
        "are no part of the benchmark's time."
    )
    return Table(title, note, ("model", "pairs of", "pairs", *CONTEXT), rows)


def _explanations(results: BenchmarkResults) -> Table | str:
    title = "10. What the forecasts owe to state, map and neighbours"
    if results.explanation is None:
        return f"{title}: left out: they were not explained (--explain)"
    rows = tuple(
        (
            model.label(results.protocol),
            str(max(one.pairs for one in model.explanation.values())),
            *(_estimate(part, model.explanation.get(part)) for part in PARTS),
        )
        for model in results.models
        if model.explanation
    )
    if not rows:
        return f"{title}: left out: no model has explanations"
    absent = (
        "drawn from donors where they fit" if results.explanation.baseline == "donors" else "the null context"
    )
    note = (
        f"{results.statement()}. Mean Shapley values, m, with 95 % intervals by bootstrap over scenes: how "
        "much nearer own state, map and neighbours bring the most likely end point at 6 s to where it is "
        f"with everything present. What is absent is {absent}. {results.explanation.pairs} pairs drawn at "
        "random. They say what forecasts follow, not whether they are right."
    )
    return Table(title, note, ("model", "pairs", *PARTS), rows)


def _estimate(name: str, one: Estimate | None) -> str:
    if one is None:
        return UNKNOWN
    show = number if name in _UNSIGNED else signed
    bounds = "" if math.isnan(one.low) else f" ({show(one.low)} … {show(one.high)})"
    return f"{show(one.value)}{bounds}"
