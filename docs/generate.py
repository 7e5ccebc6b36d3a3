"""The generated parts of the documentation: ``make docs``, or ``python -m docs.generate``.

A page marks each generated part with ``<!-- generated: NAME -->`` and ``<!-- end of NAME -->``. Everything
between the two is written from the code or the data file; the rest of the page is written by hand.
"""

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import typer

from benchmark.seeds import SeedFigure, mean_and_deviation
from benchmark.seeds import table as seeds_comparison
from cli.main import app
from docs import contract_reference
from docs.tables import table
from loadtest.peers.report import Comparisons
from model.evaluation.published import published_figures
from service.settings_reference import settings_reference

DOCS = Path(__file__).resolve().parent
BENCHMARK = DOCS / "data/benchmark_train_val.json"
"""Benchmark figures of the bundled checkpoints on nuScenes train_val."""
SEEDS = DOCS / "data/seeds_train_val.json"
"""Figures of two methods over their trainings on nuScenes train_val, by protocol."""
PEERS = DOCS / "data/peers.json"
"""Comparison with other servers, as ``make peers`` writes it."""
INPUT_CHECKS = DOCS / "data/input_checks.json"
"""Counts of ``benchmark.input_checks`` on nuScenes train_val and v1.0-mini."""

Row = dict[str, Any]


def render(page: str) -> str:
    """Return the text of a page with its generated parts renewed.

    Args:
        page: file name of the page in ``docs/``.

    Raises:
        ValueError: the page lacks a marker.
    """
    text = (DOCS / page).read_text(encoding="utf-8")
    for name, make in PAGES[page].items():
        begin, end = f"<!-- generated: {name} -->", f"<!-- end of {name} -->"
        part = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
        if len(part.findall(text)) != 1:
            raise ValueError(f'docs/{page} must hold "{begin}" and "{end}" once')
        filled = f"{begin}\n\n{make()}\n\n{end}"
        text = part.sub(lambda _, filled=filled: filled, text)  # type: ignore[misc]
    return text


def settings_table() -> str:
    """Return one row for each setting: variable, flag of ``serve``, default, range and meaning."""
    flags = serve_flags()
    return table(
        ["Variable", "Flag of `serve`", "Default", "Allowed", "Meaning"],
        [
            [
                f"`{setting.variable}`",
                f"`{flags[setting.name]}`" if setting.name in flags else "",
                "not set" if setting.default is None else f"`{setting.default}`",
                setting.allowed if _is_bound(setting.allowed) else _quoted(setting.allowed),
                _markdown(setting.meaning),
            ]
            for setting in settings_reference()
        ],
    )


def serve_flags() -> dict[str, str]:
    """Return the long flag of each parameter of ``cab-forecast serve``."""
    serve = typer.main.get_group(app).commands["serve"]
    return {
        parameter.name: next(flag for flag in parameter.opts if flag.startswith("--"))
        for parameter in serve.params
        if parameter.name is not None
    }


def displacement_table(key: str) -> str:
    """Return the table of displacement errors of one protocol."""
    return table(
        [
            "model",
            "ADE @1 … 6 s",
            "FDE @1 … 6 s",
            "OffR",
            "NLL",
            "minADE₁₀",
            "in 50 / 90 / 99 %",
            "FDE-f",
            "OffR-f",
        ],
        [
            [
                row["model"],
                " ".join(map(_two, row["ade"])),
                " ".join(map(_two, row["fde"])),
                _two(row["off_road"]),
                _two(row["nll"]),
                _two(row["min_ade_10"]),
                _slashed(row["inside_50_90_99"], str),
                _two(row["sampled_fde"]),
                _two(row["sampled_off_road"]),
            ]
            for row in benchmark(key)
        ],
    )


def merged_table() -> str:
    """Return the table of merged modes; in brackets the figures without agents that stood."""
    return table(
        [
            "model",
            "FDE",
            "FDE, merged",
            "minADE₅ / ₁₀",
            "minADE₅ / ₁₀, merged",
            "miss rate₅",
            "miss rate₅, merged",
            "brier-minFDE₅, merged",
            "merged modes for 90 %",
            "first weight",
            "NLL",
            "in 90 %",
        ],
        [
            [
                row["model"],
                _bracketed(row["fde"], _two),
                _bracketed(row["fde_merged"], _two),
                _slashed(row["min_ade_5_10"], _two),
                _slashed(row["min_ade_5_10_merged"], _two),
                _two(row["miss_rate_5"]),
                _two(row["miss_rate_5_merged"]),
                _two(row["brier_min_fde_5_merged"]),
                _two(row["merged_modes_for_90"]),
                _two(row["first_weight"]),
                _bracketed(row["nll"], _two),
                _bracketed(row["inside_90"], "{} %".format),
            ]
            for row in benchmark("merged_causal")
        ],
    )


def clean_warnings_table() -> str:
    """Return how often each check of the input is wrong: agents with a warning, in percent."""
    figures = input_checks()
    kinds = next(iter(figures.values()))["clean"]
    return table(
        ["Code", *figures],
        [["agents", *(f"{counts['agents']:,}" for counts in figures.values())]]
        + [
            [
                f"`{kind.upper()}`",
                *(
                    _slashed(
                        [counts[part][kind] / counts["agents"] for part in ("clean", "clean, with noise")],
                        "{:.3%}".format,
                    )
                    for counts in figures.values()
                ),
            ]
            for kind in kinds
        ],
    )


def faults_table() -> str:
    """Return how often each fault of the input is said; in brackets the agents that it changes much."""
    figures = input_checks()
    faults = next(iter(figures.values()))["faults"]
    return table(
        ["Fault", *figures],
        [
            [
                fault,
                *(
                    "{:.1%} ({:,})".format(
                        counts["faults"][fault][0] / counts["faults"][fault][1], counts["faults"][fault][1]
                    )
                    for counts in figures.values()
                ),
            ]
            for fault in faults
        ],
    )


def input_checks() -> dict[str, Any]:
    """Return the counts of ``benchmark.input_checks`` by data set and rate."""
    found: dict[str, Any] = json.loads(INPUT_CHECKS.read_text(encoding="utf-8"))
    return {f"{data}, {rate}": counts for data, rates in found.items() for rate, counts in rates.items()}


def consistency_table() -> str:
    """Return the table of dispersion, convergence-to-range and the hardest pairs."""
    return table(
        ["model", "D, std", "D, mean", "D, rms", "C(0.2 m)", "C(1 m)", "C(5 m)", "hardest 1 / 2 / 3 %"],
        [
            [
                row["model"],
                *(_two(row[f"dispersion_{kind}"]) for kind in ("std", "mean", "rms")),
                *(_two(row[f"convergence_{range_}"]) for range_ in ("02", "1", "5")),
                _slashed(row["hardest_fde_1_2_3"], "{:.1f}".format),
            ]
            for row in benchmark("consistency_causal")
        ],
    )


def context_table() -> str:
    """Return the measures of the use of the context: a row for each model and subset of the pairs."""
    columns = {
        "Gain": "gain_m",
        "map": "map_advantage_m",
        "neighbours": "neighbors_advantage_m",
        "control": "map_control_m",
        "compliance": "compliance",
    }
    return table(
        ["model", "pairs", *columns],
        [
            [row["model"], subset, *(_estimate(figures.get(name)) for name in columns.values())]
            for row in benchmark("context_causal")
            for subset, figures in row.items()
            if subset != "model"
        ],
    )


def _estimate(values: Sequence[float | None] | None) -> str:
    """Return "value [low, high]"."""
    if values is None or None in values:
        return "–"
    value, low, high = values
    return f"{value:.2f} [{low:.2f}, {high:.2f}]"


def paper_table(protocol: str) -> str:
    """Return the models that the paper tabulates: figures of ours at 6 s, with the paper's in brackets.

    Below a model of several trainings, of which one is bundled, stand the means ± standard deviations.
    """
    rows: dict[str, Row] = {}
    for row in benchmark(f"displacement_{protocol}"):
        if published_figures(row["model"]):
            rows[row["model"]] = dict(row)
    if protocol == "causal":
        for row in benchmark("consistency_causal"):
            if row["model"] in rows:
                rows[row["model"]] |= row
    columns: dict[str, tuple[str, Callable[[Row], float | None]]] = {
        "ADE": ("ade_ml_6s_m", lambda row: row["ade"][5]),
        "FDE": ("fde_ml_6s_m", lambda row: row["fde"][5]),
        "OffR": ("off_road_ml", lambda row: row["off_road"]),
        "FDE-f": ("fde_f_6s_m", lambda row: row["sampled_fde"]),
        "OffR-f": ("off_road_f", lambda row: row["sampled_off_road"]),
        "D, std": ("dispersion_std_m", lambda row: row.get("dispersion_std")),
        "D, mean": ("dispersion_mean_m", lambda row: row.get("dispersion_mean")),
        "C(1 m)": ("convergence_1m_s", lambda row: row.get("convergence_1")),
        "hardest 3 %": ("fde_hardest_3_m", lambda row: row.get("hardest_fde_1_2_3", [None] * 3)[2]),
    }
    shown = {
        heading: column
        for heading, column in columns.items()
        if any(column[1](row) is not None for row in rows.values())
    }
    lines = []
    for model, row in rows.items():
        paper = published_figures(model)
        figures = [(_two(get(row)), paper.get(name)) for name, get in shown.values()]
        lines.append(
            [model, *(ours if theirs is None else f"{ours} ({theirs:.2f})" for ours, theirs in figures)]
        )
        trained = {one["metric"]: one[model] for one in seeds(protocol) if model in one}
        if trained:
            count = len(next(iter(trained.values())))
            spread = (
                mean_and_deviation(trained[name], 2) if name in trained else "–" for name, _ in shown.values()
            )
            lines.append([f"{model}, {count} trainings", *spread])
    return table(["model", *shown], lines)


def seeds_table(protocol: str) -> str:
    """Return the figures of two methods over their trainings, and the differences with their intervals."""
    rows = seeds(protocol)
    a, b = (name for name in rows[0] if name not in ("figure", "metric", "interval"))
    figures = []
    for row in rows:
        low, high = (math.nan if bound is None else bound for bound in row["interval"])
        figures.append(SeedFigure(row["figure"], row["metric"], tuple(row[a]), tuple(row[b]), (low, high)))
    made = seeds_comparison(figures, a, b)
    return table(made.columns, made.rows)


def seeds(protocol: str) -> list[Row]:
    """Return a row for each figure of two methods over their trainings."""
    rows: list[Row] = json.loads(SEEDS.read_text(encoding="utf-8"))[protocol]
    return rows


def scale_table() -> str:
    """Return a row for each main figure, with those of three models from the simplest to the best."""
    models = ("constant-velocity-yaw", "trajectron-no-context", "cab")
    rows = {
        model: {
            name: value
            for key in ("displacement_causal", "consistency_causal")
            for row in benchmark(key)
            if row["model"] == model
            for name, value in row.items()
        }
        for model in models
    }
    figures: dict[str, Callable[[Row], str]] = {
        "FDE at 1 s, m": lambda row: _two(row["fde"][0]),
        "FDE at 3 s, m": lambda row: _two(row["fde"][2]),
        "FDE at 6 s, m": lambda row: _two(row["fde"][5]),
        "minADE₁₀, m": lambda row: _two(row["min_ade_10"]),
        "NLL, nats a step": lambda row: _two(row["nll"]),
        "in 50 / 90 / 99 %": lambda row: _slashed(row["inside_50_90_99"], str),
        "OffR": lambda row: _two(row["off_road"]),
        "D, std, m": lambda row: _two(row["dispersion_std"]),
        "C(1 m), s": lambda row: _two(row["convergence_1"]),
        "hardest 1 %, m": lambda row: "{:.1f}".format(row["hardest_fde_1_2_3"][0]),
    }
    return table(
        ["Figure", *models],
        [[figure, *(show(rows[model]) for model in models)] for figure, show in figures.items()],
    )


def benchmark(key: str) -> list[Row]:
    """Return the rows of one table of the benchmark figures."""
    rows: list[Row] = json.loads(BENCHMARK.read_text(encoding="utf-8"))[key]
    return rows


PAGES: dict[str, dict[str, Callable[[], str]]] = {
    "contract.md": {
        "methods": contract_reference.methods_table,
        "contract": contract_reference.contract,
    },
    "experiments.md": {"seeds_causal": lambda: seeds_table("causal")},
    "figures.md": {"scale": scale_table},
    "performance.md": {"peers": lambda: Comparisons.read(PEERS).markdown()},
    "settings.md": {"settings": settings_table},
    "warnings.md": {"clean": clean_warnings_table, "faults": faults_table},
    "models.md": {
        "displacement_causal": lambda: displacement_table("displacement_causal"),
        "merged_causal": merged_table,
        "consistency_causal": consistency_table,
        "context_causal": context_table,
        "displacement_paper": lambda: displacement_table("displacement_paper"),
        "beside_paper_causal": lambda: paper_table("causal"),
        "beside_paper_paper": lambda: paper_table("paper"),
    },
}
"""Functions that write the generated parts, by page and name."""


def main() -> None:
    """Renew the generated parts of all pages."""
    for page in PAGES:
        (DOCS / page).write_text(render(page), encoding="utf-8")


def _is_bound(allowed: str) -> bool:
    return allowed.startswith((">", "≥"))


def _quoted(choices: str) -> str:
    return ", ".join(f"`{choice}`" for choice in choices.split(", ") if choice)


def _markdown(meaning: str) -> str:
    return meaning.replace("``", "`").replace("|", "\\|")


def _two(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _slashed(values: Sequence[float] | None, form: Callable[[Any], str]) -> str:
    return "–" if values is None else " / ".join(map(form, values))


def _bracketed(values: Sequence[float], form: Callable[[Any], str]) -> str:
    """Return "all (without agents that stood)"."""
    every, moving = values
    return f"{form(every)} ({form(moving)})"


if __name__ == "__main__":
    main()
