"""Results as tables of text."""

import math
from collections.abc import Mapping, Sequence

from model.evaluation.ablation import Without
from model.evaluation.published import PUBLISHED
from model.evaluation.results import Results, Row
from model.evaluation.text_tables import NOTHING, Table, document, metrics_table, number
from model.metrics.displacement import HORIZONS_S
from model.metrics.standing import STANDING_FRAMES, STANDING_M
from model.scenes.scene import STEP_SECONDS

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
"""Figures of merged modes by heading."""
MERGED_NOTE = (
    "best of the k likeliest merged modes at 6 s, m; brier-minFDE: minFDE and (1 − p)², p the probability of "
    "the mode that ends nearest; hold 90 %: how many merged modes have 90 % of the probability; first "
    "weight: probability of the likeliest one; ADE and FDE: of that one."
)
"""What they are."""
WITHOUT_STANDING = {
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
"""The main figures without those that stood, by heading."""
STOOD_NOTE = (
    f"for {STANDING_FRAMES * STEP_SECONDS:g} s it was seen at every frame, never {STANDING_M:g} m from where "
    "it is."
)
"""Who they are."""


def tables(results: Results) -> list[Table]:
    """The likeliest trajectory, the whole forecast, the merged modes, the main figures without the agents
    that stood, the paper's figures beside ours where there are any, and, where it was asked for, what the
    context is worth."""
    made = [_most_likely(results), _whole(results), _merged(results), _moving(results)]
    if any(row.name in PUBLISHED for row in results.rows):
        made.append(_beside_the_paper(results))
    if results.ablate:
        made.append(_context(results))
    return made


def markdown(results: Results) -> str:
    """All tables, each with what it is of."""
    return document(f"Evaluation: {results.statement()}", tables(results))


def _most_likely(results: Results) -> Table:
    columns = {f"ADE {second} s": f"ade_ml_{second}s_m" for second in HORIZONS_S}
    columns |= {f"FDE {second} s": f"fde_ml_{second}s_m" for second in HORIZONS_S}
    columns["OffR"] = "off_road_ml"
    note = f"{results.statement()}. ADE-ML and FDE-ML in m; OffR-ML: share that leaves the driveable area."
    return _plain("The most likely trajectory", note, columns, results.rows)


def _whole(results: Results) -> Table:
    columns = {
        "ADE-f": "ade_f_6s_m",
        "FDE-f": "fde_f_6s_m",
        "OffR-f": "off_road_f",
        "NLL": "nll",
        "minADE_5, raw": "min_ade_5_m",
        "minADE_10, raw": "min_ade_10_m",
        "miss rate 5, raw": "miss_rate_5",
        "miss rate 10, raw": "miss_rate_10",
        "inside 50 %": "inside_50",
        "inside 90 %": "inside_90",
        "inside 99 %": "inside_99",
    }
    note = (
        f"{results.statement()}. At 6 s, in m; f: mean over the sampled trajectories; NLL: nats a step; "
        "miss: every one of the k modes is 2 m off somewhere; inside p %: share of the steps at which the "
        "truth is in the region that is said to hold p %."
    )
    return _plain("The whole forecast", note, columns, results.rows)


def _merged(results: Results) -> Table:
    note = (
        f"{results.statement()}. Modes that a planner would not tell apart merged into one, weights summed; "
        f"{MERGED_NOTE}"
    )
    return _plain("Merged modes", note, MERGED, results.rows)


def _moving(results: Results) -> Table:
    note = (
        f"{results.statement()}. The main figures without the pairs whose agent stood before now: "
        f"{STOOD_NOTE} Raw: the model's own modes."
    )
    return _plain("Without those that stood", note, WITHOUT_STANDING, results.rows)


def _beside_the_paper(results: Results) -> Table:
    figures = {
        "ADE": "ade_ml_6s_m",
        "FDE": "fde_ml_6s_m",
        "OffR": "off_road_ml",
        "ADE-f": "ade_f_6s_m",
        "FDE-f": "fde_f_6s_m",
        "OffR-f": "off_road_f",
    }
    columns = ["model", *(f"{name}{whose}" for name in figures for whose in ("", " (paper)"))]
    rows = []
    for row in results.rows:
        if row.name in PUBLISHED:
            theirs = PUBLISHED[row.name].figures()
            pairs = ((_number(row.metrics, name), _number(theirs, name)) for name in figures.values())
            rows.append((_label(row, results.rows), *(cell for pair in pairs for cell in pair)))
    note = (
        f"Ours: {results.statement()}. (paper): Ben-Younes et al. 2022, table 1: paper protocol, its own "
        "split, 2000 sampled trajectories. At 6 s, in m; the most likely trajectory, and f: samples."
    )
    return Table("Beside the paper's figures", note, tuple(columns), tuple(rows))


def _context(results: Results) -> Table:
    names = {Without.MAP: "no map", Without.NEIGHBORS: "no neighbours", Without.BOTH: "neither"}
    figures = {"ADE": "ade_ml_6s_m", "FDE": "fde_ml_6s_m"}
    columns = ["model"]
    for figure in figures:
        columns += [figure, *(f"{figure}, {name}" for name in names.values())]
    rows = []
    for row in results.rows:
        if row.learned:
            cells = [_label(row, results.rows)]
            for figure in figures.values():
                cells.append(_number(row.metrics, figure))
                cells += [_loss(row, without, figure) for without in names]
            rows.append(tuple(cells))
    note = (
        f"{results.statement()}. ADE-ML and FDE-ML at 6 s in m with everything, then how much greater they "
        "are with the map unknown, without neighbours, and without both."
    )
    return Table("Does the context matter?", note, tuple(columns), tuple(rows))


def _plain(title: str, note: str, columns: Mapping[str, str], rows: Sequence[Row]) -> Table:
    """A column a metric."""
    return metrics_table(title, note, columns, ((_label(row, rows), row.metrics) for row in rows))


def _label(row: Row, rows: Sequence[Row]) -> str:
    """The name, with the version where another row has that name, too."""
    twice = sum(other.name == row.name for other in rows) > 1
    return f"{row.name}@{row.version}" if twice else row.name


def _number(figures: Mapping[str, float], name: str) -> str:
    return number(figures.get(name, math.nan))


def _loss(row: Row, without: Without, figure: str) -> str:
    """How much greater a figure is without something: "+0.31 (+4 %)"."""
    if without not in row.ablated:
        return NOTHING
    whole, less = row.metrics[figure], row.ablated[without][figure]
    percent = f" ({100 * (less - whole) / whole:+.1f} %)" if whole else ""
    return f"{less - whole:+.2f}{percent}"
