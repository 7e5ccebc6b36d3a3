"""Tables of text: those that evaluation and benchmark share, and the ablations of an evaluation.

Each function returns a table, or a line that says why it is left out.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from model.evaluation.ablation import Without
from model.evaluation.published import PUBLISHED, Published, PublishedConsistency, PublishedHardCases
from model.evaluation.results import EvaluationModelResult, EvaluationResults, Results
from model.metrics.displacement import HORIZONS_S
from model.metrics.multimodal import MISS_TOLERANCE_M, TOP_K
from model.metrics.standing import STANDING_FRAMES, STANDING_M
from model.scenes.scene import STEP_SECONDS

UNKNOWN = "-"
"""Cell of an unknown figure."""
DISPLACEMENT = {
    **{f"ADE {second} s": f"ade_ml_{second}s_m" for second in HORIZONS_S},
    **{f"FDE {second} s": f"fde_ml_{second}s_m" for second in HORIZONS_S},
    "OffR": "off_road_ml",
    "ADE-f": "ade_f_6s_m",
    "FDE-f": "fde_f_6s_m",
    "OffR-f": "off_road_f",
}
MERGED = {
    "minADE_5": "merged_min_ade_5_m",
    "minADE_10": "merged_min_ade_10_m",
    "minFDE_5": "merged_min_fde_5_m",
    "minFDE_10": "merged_min_fde_10_m",
    "miss rate 5": "merged_miss_rate_5",
    "miss rate 10": "merged_miss_rate_10",
    "brier-minFDE_5": "merged_brier_min_fde_5_m",
    "hold 90 %, median": "merged_modes_90_median",
    "hold 90 %, mean": "merged_modes_90",
    "first weight": "merged_first_weight",
    "ADE": "ade_merged_6s_m",
    "FDE": "fde_merged_6s_m",
}
MOVING = {
    "FDE": "moving_fde_ml_6s_m",
    "OffR": "moving_off_road_ml",
    "OffR-f": "moving_off_road_f",
    "NLL": "moving_nll",
    "inside 90 %": "moving_inside_90",
    "minADE_5, raw": "moving_min_ade_5_m",
    "minADE_10, raw": "moving_min_ade_10_m",
    "miss rate 5, raw": "moving_miss_rate_5",
    "FDE, merged": "moving_fde_merged_6s_m",
    "minADE_5, merged": "moving_merged_min_ade_5_m",
    "minADE_10, merged": "moving_merged_min_ade_10_m",
    "miss rate 5, merged": "moving_merged_miss_rate_5",
    "brier-minFDE_5, merged": "moving_merged_brier_min_fde_5_m",
    "hold 90 %, median": "moving_merged_modes_90_median",
}


@dataclass(frozen=True)
class Table:
    """Columns of text; the first holds the model."""

    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def number(value: float, digits: int = 2) -> str:
    """Return a figure as text; counts without decimals."""
    if isinstance(value, int):
        return str(value)
    return UNKNOWN if math.isnan(value) else f"{value:.{digits}f}"


def signed(value: float, digits: int = 2) -> str:
    """Return a difference as text, with its sign."""
    return UNKNOWN if math.isnan(value) else f"{value:+.{digits}f}"


def document(title: str, tables: Iterable[Table], lines: Sequence[str] = ()) -> str:
    """Return tables as one Markdown document.

    Args:
        title: title of the document.
        tables: the tables in order.
        lines: list items before the tables.
    """
    parts = [f"# {title}"]
    if lines:
        parts.append("\n".join(f"- {line}" for line in lines))
    for table in tables:
        parts.append(f"## {table.title}\n\n{table.note}")
        rows = [table.columns, ("---", *("--:" for _ in table.columns[1:])), *table.rows]
        parts.append("\n".join(_line(row) for row in rows))
    return "\n\n".join(parts) + "\n"


def metrics_table(
    results: Results,
    title: str,
    note: str,
    columns: Mapping[str, str],
    why_empty: str,
    figures: Sequence[Mapping[str, float]] | None = None,
    digits: int = 2,
) -> Table | str:
    """Return a table with a row for each model that has any of the figures.

    Args:
        results: the results.
        title: title of the table.
        note: meaning of the columns.
        columns: names of the figures by heading.
        why_empty: reason if no model has any of the figures.
        figures: figures of each model by name; None: its metrics.
        digits: decimals.
    """
    named = zip(results.models, figures or [model.metrics for model in results.models], strict=True)
    rows = [
        (
            model.label(results.protocol),
            *(number(own.get(name, math.nan), digits) for name in columns.values()),
        )
        for model, own in named
        if any(is_known(own, name) for name in columns.values())
    ]
    if not rows:
        return f"{title}: left out: {why_empty}"
    return Table(title, f"{results.statement()}. {note}", ("model", *columns), tuple(rows))


def is_known(figures: Mapping[str, float], name: str) -> bool:
    """Return whether a figure is there and not NaN."""
    return not math.isnan(figures.get(name, math.nan))


def displacement_table(results: Results) -> Table | str:
    """Return table 1: the most likely trajectory, and sampled ones."""
    sampled = (
        f"f: mean over {results.samples} sampled trajectories a pair, at 6 s"
        if results.samples
        else "f: no trajectories were sampled"
    )
    note = (
        "ADE and FDE of the most likely trajectory, m; OffR: share of these trajectories that leave the "
        f"driveable area; {sampled}."
    )
    return metrics_table(results, "1. Displacement and driveable area", note, DISPLACEMENT, "no forecasts")


def raw_modes_table(results: Results) -> Table | str:
    """Return table 4: the model's own modes."""
    columns = {f"minADE_{k}": f"min_ade_{k}_m" for k in TOP_K}
    columns |= {f"minFDE_{k}": f"min_fde_{k}_m" for k in TOP_K}
    columns |= {f"miss rate {k}": f"miss_rate_{k}" for k in TOP_K}
    note = (
        f"Best of the model's k most likely modes, at 6 s, m; miss: each of them is {MISS_TOLERANCE_M:g} m "
        "off at some step."
    )
    return metrics_table(results, "4. Raw modes", note, columns, "no forecasts")


def merged_modes_table(results: Results) -> Table | str:
    """Return table 4.1: merged modes."""
    note = (
        "Modes that a planner would not tell apart are merged, their weights summed; best of the k most "
        "likely merged modes at 6 s, m; brier-minFDE: minFDE + (1 − p)², p: probability of the mode with the "
        "nearest end; hold 90 %: number of merged modes that hold 90 % of the probability; first weight: "
        "probability of the most likely merged mode; ADE and FDE: of that mode."
    )
    return metrics_table(
        results, "4.1 Merged modes", note, MERGED, "no forecasts of a version that merges modes"
    )


def moving_table(results: Results) -> Table | str:
    """Return table 4.2: the main figures without standing agents."""
    note = (
        "Without the pairs whose agent stood before now: it was seen at every frame of the last "
        f"{STANDING_FRAMES * STEP_SECONDS:g} s, always less than {STANDING_M:g} m from where it is now. Raw: "
        "the model's own modes; merged: as in table 4.1."
    )
    return metrics_table(
        results, "4.2 Without standing agents", note, MOVING, "no figures without standing agents"
    )


def likelihood_table(results: Results) -> Table | str:
    """Return table 5: likelihood and calibration."""
    columns = {"NLL": "nll", "NLL 1 s": "nll_1s", "NLL 3 s": "nll_3s", "NLL 6 s": "nll_6s"}
    columns |= {f"inside {percent} %": f"inside_{percent}" for percent in (50, 90, 99)}
    drawn = f"from {results.draws} draws a step" if results.draws else "not computed"
    note = (
        "NLL: nats, mean over the steps, and at one step; inside p %: share of the steps at which the truth "
        f"lies in the p % highest-density region ({drawn})."
    )
    return metrics_table(results, "5. Likelihood and calibration", note, columns, "no forecasts", digits=3)


def paper_table(
    results: Results,
    table: int,
    columns: Mapping[str, str],
    published: Mapping[str, Published | PublishedConsistency | PublishedHardCases],
) -> Table | str:
    """Return table 7: our figures, those of the paper, and the difference.

    Args:
        results: the results.
        table: number of the table in the paper.
        columns: names of the figures by heading.
        published: rows of the paper's table by model.
    """
    title = f"7.{table} Comparison with the paper's table {table}"
    both = []
    for model in results.models:
        if model.name in published:
            theirs = published[model.name].figures()
            if any(is_known(model.metrics, name) for name in theirs):
                both.append((model, theirs))
    if not both:
        return f"{title}: left out: no model has a figure of it"
    shown = {heading: name for heading, name in columns.items() if any(name in theirs for _, theirs in both)}
    rows = []
    for model, theirs in both:
        ours = [model.metrics.get(name, math.nan) for name in shown.values()]
        paper = [theirs.get(name, math.nan) for name in shown.values()]
        differences = [signed(our - their) for our, their in zip(ours, paper, strict=True)]
        label = model.label(results.protocol)
        rows += [
            (label, "ours", *map(number, ours)),
            (label, "paper", *map(number, paper)),
            (label, "ours − paper", *differences),
        ]
    note = (
        f"Ours: {results.statement()}. Paper: Ben-Younes et al. 2022, table {table}: paper protocol, its own "
        "split, 2000 sampled trajectories."
    )
    if "dispersion_std_m" in shown.values():
        note += (
            " The paper has one D: its formula is the standard deviation, but its figures fit the mean "
            "distance better, so it is compared with both."
        )
    return Table(title, note, ("model", "whose", *shown), tuple(rows))


def tables(results: EvaluationResults) -> list[Table]:
    """Return the tables of an evaluation that are not empty."""
    return [made for made in _all(results) if isinstance(made, Table)]


def markdown(results: EvaluationResults) -> str:
    """Return all tables of an evaluation as one document, with the reasons for those left out."""
    left_out = [made for made in _all(results) if isinstance(made, str)]
    return document(f"Evaluation: {results.statement()}", tables(results), left_out)


def _all(results: EvaluationResults) -> list[Table | str]:
    """Return tables of the benchmark's numbers, and that of the ablations."""
    made = [
        displacement_table(results),
        raw_modes_table(results),
        merged_modes_table(results),
        moving_table(results),
        likelihood_table(results),
        paper_table(results, 1, DISPLACEMENT, PUBLISHED),
    ]
    return [*made, _ablation_table(results)] if results.ablate else made


def _ablation_table(results: EvaluationResults) -> Table | str:
    title = "9. Context ablation"
    names = {Without.MAP: "no map", Without.NEIGHBORS: "no neighbours", Without.BOTH: "neither"}
    figures = {"ADE": "ade_ml_6s_m", "FDE": "fde_ml_6s_m"}
    columns = ["model"]
    for heading in figures:
        columns += [heading, *(f"{heading}, {name}" for name in names.values())]
    rows = []
    for model in results.models:
        if model.learned:
            cells = [model.label(results.protocol)]
            for figure in figures.values():
                cells.append(number(model.metrics.get(figure, math.nan)))
                cells += [_increase(model, without, figure) for without in names]
            rows.append(tuple(cells))
    if not rows:
        return f"{title}: left out: no learned models"
    note = (
        f"{results.statement()}. ADE and FDE of the most likely trajectory at 6 s, m, with full context, and "
        "their increase with an unknown map, without neighbours, and without both."
    )
    return Table(title, note, tuple(columns), tuple(rows))


def _increase(model: EvaluationModelResult, without: Without, figure: str) -> str:
    """Return the increase of a figure without a part of the context: "+0.31 (+4.0 %)"."""
    if without not in model.ablated:
        return UNKNOWN
    full, less = model.metrics[figure], model.ablated[without][figure]
    percent = f" ({100 * (less - full) / full:+.1f} %)" if full else ""
    return f"{less - full:+.2f}{percent}"


def _line(cells: Sequence[str]) -> str:
    escaped = (cell.replace("|", r"\|") for cell in cells)
    return f"| {' | '.join(escaped)} |"
