"""Benchmark figures in docs/data: ``python -m docs.benchmark_rows CAUSAL/results.json …``.

Each file is the results of ``cab-forecast benchmark`` on train_val. Rows of its models replace those of the
same name and protocol; all others stay. With ``--seeds A B`` each file is of a training of A or B, and these
two are compared instead (``benchmark.seeds``). With ``--keep NAME`` the one file's run is kept in
docs/data/trainings/NAME, without the figures of single pairs, for comparisons with later trainings.
``make docs`` then renews the tables.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from packaging.version import Version

from benchmark.compare import KEY_FIGURES
from benchmark.results import BenchmarkResults, Instances
from benchmark.seeds import compare_seeds
from docs.generate import BENCHMARK, DOCS, SEEDS, Row

TRAININGS = DOCS / "data/trainings"
"""Runs of trainings, most of whose checkpoints are not bundled."""
Metrics = Mapping[str, float | None]


def displacement_row(metrics: Metrics) -> Row:
    """Return the figures of one model in a table of displacement errors."""
    return {
        "ade": [_number(metrics, f"ade_ml_{second}s_m") for second in range(1, 7)],
        "fde": [_number(metrics, f"fde_ml_{second}s_m") for second in range(1, 7)],
        "off_road": _number(metrics, "off_road_ml"),
        "nll": _number(metrics, "nll"),
        "min_ade_10": _number(metrics, "min_ade_10_m"),
        "inside_50_90_99": _all_or_none([_percent(metrics, f"inside_{share}") for share in (50, 90, 99)]),
        "sampled_fde": _number(metrics, "fde_f_6s_m"),
        "sampled_off_road": _number(metrics, "off_road_f"),
    }


def merged_row(metrics: Metrics) -> Row:
    """Return the figures of one model in the table of merged modes; pairs: all, without standing agents."""
    return {
        "fde": _with_moving(metrics, "fde_ml_6s_m"),
        "fde_merged": _with_moving(metrics, "fde_merged_6s_m"),
        "min_ade_5_10": [_number(metrics, f"min_ade_{count}_m") for count in (5, 10)],
        "min_ade_5_10_merged": [_number(metrics, f"merged_min_ade_{count}_m") for count in (5, 10)],
        "miss_rate_5": _number(metrics, "miss_rate_5"),
        "miss_rate_5_merged": _number(metrics, "merged_miss_rate_5"),
        "brier_min_fde_5_merged": _number(metrics, "merged_brier_min_fde_5_m"),
        "merged_modes_for_90": _number(metrics, "merged_modes_90"),
        "first_weight": _number(metrics, "merged_first_weight"),
        "nll": _with_moving(metrics, "nll"),
        "inside_90": [_percent(metrics, "inside_90"), _percent(metrics, "moving_inside_90")],
    }


def consistency_row(metrics: Metrics) -> Row:
    """Return the figures of one model in the table of dispersion, convergence-to-range and hard cases."""
    return {
        **{f"dispersion_{kind}": _number(metrics, f"dispersion_{kind}_m") for kind in ("std", "mean", "rms")},
        "convergence_02": _number(metrics, "convergence_0.2m_s"),
        "convergence_1": _number(metrics, "convergence_1m_s"),
        "convergence_5": _number(metrics, "convergence_5m_s"),
        "hardest_fde_1_2_3": [_number(metrics, f"fde_hardest_{share}_m", 1) for share in (1, 2, 3)],
    }


def context_row(measures: Mapping[str, Mapping[str, Mapping[str, float | None]]]) -> Row:
    """Return value and bounds of the measures of one model's use of the context, by subset and name."""
    return {
        subset: {
            name: [_number(one, bound) for bound in ("value", "low", "high")] for name, one in figures.items()
        }
        for subset, figures in measures.items()
    }


def with_results(data: dict[str, list[Row]], results: Mapping[str, Any]) -> dict[str, list[Row]]:
    """Return the data with the rows of a benchmark's models in place of those of the same names.

    Args:
        data: rows by table.
        results: contents of a benchmark's ``results.json``.

    Raises:
        ValueError: the results are of a part of the pairs, or of another split than train_val.
    """
    _check_whole(results["split"], results["limit"])
    protocol = results["protocol"]
    made: dict[str, Callable[[Metrics], Row]] = {f"displacement_{protocol}": displacement_row}
    if protocol == "causal":
        made |= {"merged_causal": merged_row, "consistency_causal": consistency_row}
    renewed = {table: {row["model"]: row for row in rows} for table, rows in data.items()}
    labels = _labels(results["models"])
    for model, label in zip(results["models"], labels, strict=True):
        if model["protocol"] not in ("any", protocol):
            continue
        for table, make in made.items():
            row = {"model": label, **make(model["metrics"])}
            whole = table != "merged_causal" or (
                row["fde_merged"][0] is not None and model["protocol"] != "any"
            )
            if whole:
                renewed[table][label] = row
        compared_with = (results.get("context") or {}).get("no_context")
        known = model.get("context") and compared_with != f"{model['name']}@{model['version']}"
        if protocol == "causal" and model["protocol"] == protocol and known:
            renewed["context_causal"][label] = {"model": label, **context_row(model["context"])}
    return {table: list(rows.values()) for table, rows in renewed.items()}


def _check_whole(split: str, limit: int | None) -> None:
    """Refuse figures of other pairs.

    Raises:
        ValueError: they are of a part of the pairs, or of another split than train_val.
    """
    if split != "train_val" or limit is not None:
        raise ValueError("the tables hold figures of the whole of train_val")


def _labels(models: list[Mapping[str, Any]]) -> list[str]:
    """Return the names of models in tables; of several versions all but the newest have theirs behind."""
    newest: dict[str, tuple[int, ...]] = {}
    for model in models:
        newest[model["name"]] = max(newest.get(model["name"], ()), Version(model["version"]).release)
    return [
        model["name"]
        if Version(model["version"]).release == newest[model["name"]]
        else f"{model['name']} {model['version']}"
        for model in models
    ]


def _number(metrics: Metrics, name: str, digits: int = 2) -> float | None:
    value = metrics.get(name)
    return None if value is None or math.isnan(value) else round(value, digits)


def _percent(metrics: Metrics, name: str) -> int | None:
    value = metrics.get(name)
    return None if value is None or math.isnan(value) else round(100 * value)


def _with_moving(metrics: Metrics, name: str) -> list[float | None]:
    return [_number(metrics, name), _number(metrics, f"moving_{name}")]


def _all_or_none(values: list[int | None]) -> list[int | None] | None:
    return None if None in values else values


def with_comparison(
    data: Mapping[str, list[Row]], runs: Sequence[Path], names: tuple[str, str]
) -> dict[str, list[Row]]:
    """Return the comparisons over trainings with that of two models, under the runs' protocol.

    Args:
        data: a row for each figure by protocol.
        runs: folders of benchmarks on train_val, each of a training of one of the models or both.
        names: names of the two models.

    Raises:
        ValueError: a run is of a part of the pairs, or of another split than train_val; or it is one model.
        BenchmarkError: the runs cannot be compared.
    """
    if names[0] == names[1]:
        raise ValueError(f"{names[0]} cannot be compared with itself")
    results = [BenchmarkResults.read(run) for run in runs]
    for one in results:
        _check_whole(one.split, one.limit)
    rows = [
        {
            "figure": one.figure,
            "metric": one.metric,
            names[0]: [round(value, 4) for value in one.a],
            names[1]: [round(value, 4) for value in one.b],
            "interval": [None if math.isnan(bound) else round(bound, 4) for bound in one.interval],
        }
        for one in compare_seeds(runs, *names)
    ]
    return {**data, results[0].protocol.value: rows}


def keep(run: Path, folder: Path) -> None:
    """Keep a run's results, and the figures of its models by scenes.

    Args:
        run: folder of a benchmark on train_val.
        folder: where they are kept; it must not exist.

    Raises:
        ValueError: the run is of a part of the pairs, or of another split than train_val, or lacks a figure
            by scenes.
        FileExistsError: the folder exists.
    """
    results = BenchmarkResults.read(run)
    _check_whole(results.split, results.limit)
    kept = Instances.read(run, results.pairs).by_scenes(
        [model.key for model in results.models], list(KEY_FIGURES.values())
    )
    for model in results.models:
        for figure in KEY_FIGURES.values():
            if not math.isnan(model.figure(figure)) and kept.ratio(model.key, figure) is None:
                raise ValueError(f"{run}: does not hold {figure} of {model.key} by scenes")
    folder.mkdir(parents=True)
    replace(results, endpoint="", refusals=()).write(folder)
    kept.write(folder)


def main(
    results: Annotated[list[Path], typer.Argument(help="results.json of benchmarks on train_val")],
    seeds: Annotated[
        tuple[str, str] | None, typer.Option(metavar="A B", help="Compare two models over their trainings.")
    ] = None,
    name: Annotated[
        str | None, typer.Option("--keep", help="Keep the one run for comparisons with later trainings.")
    ] = None,
) -> None:
    """Renew the rows of each file's models in ``docs/data``, or the comparison over trainings."""
    if name is not None:
        if len(results) != 1 or seeds is not None:
            raise typer.BadParameter("--keep takes one file, and no --seeds")
        keep(results[0].parent, TRAININGS / name)
        return
    file = BENCHMARK if seeds is None else SEEDS
    data = json.loads(file.read_text(encoding="utf-8"))
    if seeds is not None:
        data = with_comparison(data, [one.parent for one in results], seeds)
    else:
        for one in results:
            data = with_results(data, json.loads(one.read_text(encoding="utf-8")))
    tables = [
        f"  {json.dumps(table)}: [\n" + ",\n".join(f"    {json.dumps(row)}" for row in rows) + "\n  ]"
        for table, rows in data.items()
    ]
    file.write_text("{\n" + ",\n".join(tables) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
