"""Rows of the benchmark's tables in the documentation, from results files."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmark.results import PER_INSTANCE, Instances
from docs import generate
from docs.benchmark_rows import keep, with_comparison, with_results
from docs.generate import BENCHMARK
from tests.benchmark.builders import made_metrics, made_model, made_results

FIGURES = {
    **{f"{kind}_ml_{second}s_m": 0.123 + second for kind in ("ade", "fde") for second in range(1, 7)},
    **{f"inside_{share}": share / 100 + 0.004 for share in (50, 90, 99)},
    "off_road_ml": 0.126,
    "off_road_f": 0.2,
    "nll": 3.004,
    "moving_nll": 2.5,
    "min_ade_10_m": 1.5,
    "fde_f_6s_m": 10.0,
    "fde_merged_6s_m": 6.5,
    "moving_fde_merged_6s_m": 6.25,
    "dispersion_std_m": 1.75,
    "fde_hardest_1_m": 20.06,
}


def results(*models: tuple[str, str, str], protocol: str = "causal", **changes: Any) -> dict[str, Any]:
    made = [{"name": n, "version": v, "protocol": p, "metrics": FIGURES} for n, v, p in models]
    return {"split": "train_val", "limit": None, "protocol": protocol, "models": made} | changes


def data() -> dict[str, list[dict[str, Any]]]:
    content: dict[str, list[dict[str, Any]]] = json.loads(BENCHMARK.read_text(encoding="utf-8"))
    return content


def row(tables: dict[str, list[dict[str, Any]]], table: str, model: str) -> dict[str, Any]:
    (found,) = [one for one in tables[table] if one["model"] == model]
    return found


def test_a_row_is_renewed_in_its_place_and_has_the_fields_of_the_others() -> None:
    before = data()
    after = with_results(before, results(("rubiz", "9.0.0", "causal")))
    for table in ("displacement_causal", "consistency_causal"):
        assert [one["model"] for one in after[table]] == [one["model"] for one in before[table]]
        assert row(after, table, "rubiz").keys() == row(before, table, "cab").keys()
    assert row(after, "merged_causal", "rubiz").keys() == row(before, "merged_causal", "cab").keys()
    assert after["displacement_paper"] == before["displacement_paper"]
    assert row(after, "displacement_causal", "cab") == row(before, "displacement_causal", "cab")


def test_figures_are_rounded_and_missing_ones_have_no_value() -> None:
    tables = with_results(data(), results(("rubiz", "9.0.0", "causal")))
    shown = row(tables, "displacement_causal", "rubiz")
    assert shown["fde"] == [1.12, 2.12, 3.12, 4.12, 5.12, 6.12]
    assert shown["inside_50_90_99"] == [50, 90, 99]
    assert (shown["off_road"], shown["nll"]) == (0.13, 3.0)
    shown = row(tables, "merged_causal", "rubiz")
    assert shown["fde_merged"] == [6.5, 6.25]
    assert shown["inside_90"] == [90, None]
    shown = row(tables, "consistency_causal", "rubiz")
    assert (shown["dispersion_std"], shown["dispersion_rms"]) == (1.75, None)
    assert shown["hardest_fde_1_2_3"] == [20.1, None, None]


def test_older_versions_are_named_with_them() -> None:
    models = (("cab", "2.10.0", "causal"), ("cab", "2.9.0", "causal"), ("kalman", "1.0.0", "any"))
    tables = with_results(data(), results(*models))
    assert row(tables, "displacement_causal", "cab 2.9.0")["nll"] == 3.0
    assert [one["model"] for one in tables["merged_causal"]][:1] == ["cab"]
    assert not [one for one in tables["merged_causal"] if one["model"] == "kalman"]


def test_a_protocol_takes_models_of_its_own_only() -> None:
    models = (("cab", "3.0.0+paper", "paper"), ("reweight", "1.0.0", "causal"), ("kalman", "1.0.0", "any"))
    tables = with_results(data(), results(*models, protocol="paper"))
    assert row(tables, "displacement_paper", "cab")["nll"] == 3.0
    assert row(tables, "displacement_paper", "kalman")["nll"] == 3.0
    assert not [one for one in tables["displacement_paper"] if one["model"] == "reweight"]


@pytest.mark.parametrize("change", [{"split": "val"}, {"limit": 300}])
def test_figures_of_other_pairs_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="whole of train_val"):
        with_results(data(), results(("cab", "9.0.0", "causal"), **change))


def test_the_use_of_the_context_is_shown_with_its_intervals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimate = {"value": 1.234, "low": 0.5, "high": 2.0, "pairs": 9}
    unknown = {"value": None, "low": None, "high": None, "pairs": 0}
    measured = results(("rubiz", "9.0.0", "causal"), ("made-up", "1.0.0", "causal"))
    measured["context"] = {"no_context": "made-up@1.0.0"}
    for model in measured["models"]:
        model["context"] = {"all": {"gain_m": estimate, "compliance": unknown}}
    tables = with_results(data(), measured)
    assert "made-up" not in {one["model"] for one in tables["context_causal"]}
    assert row(tables, "context_causal", "rubiz")["all"]["gain_m"] == [1.23, 0.5, 2.0]
    file = tmp_path / "benchmark.json"
    file.write_text(json.dumps(tables))
    monkeypatch.setattr(generate, "BENCHMARK", file)
    assert "| rubiz | all | 1.23 [0.50, 2.00] | – | – | – | – |" in generate.context_table().splitlines()


def trainings(folder: Path, split: str = "train_val") -> list[Path]:
    """Two runs, each with a training of two models."""
    runs = []
    for seed, (a, b) in enumerate([(8.0, 7.0), (9.0, 7.5)]):
        runs.append(folder / str(seed))
        runs[-1].mkdir()
        others = {name: value for name, value in made_metrics().items() if name in PER_INSTANCE}
        models = [
            replace(made_model(name, metrics=others | {"fde_ml_6s_m": value}), context={})
            for name, value in {"trajectron": a, "cab": b}.items()
        ]
        replace(made_results(*models), split=split, limit=None, pairs=4).write(runs[-1])
        each = {
            f"{model.key}/{name}": np.full(4, model.metrics[name])
            for model in models
            for name in PER_INSTANCE
            if name in model.metrics
        }
        Instances(each, np.array([0, 0, 1, 1])).write(runs[-1])
    return runs


def test_two_models_are_compared_over_their_trainings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = with_comparison({"causal": [], "paper": []}, trainings(tmp_path), ("trajectron", "cab"))
    assert rows["paper"] == []
    (fde,) = [row for row in rows["causal"] if row["figure"] == "FDE-ML 6 s"]
    assert (fde["trajectron"], fde["cab"]) == ([8.0, 9.0], [7.0, 7.5])
    assert fde["interval"][0] < -1.25 < fde["interval"][1]
    data = tmp_path / "seeds.json"
    data.write_text(json.dumps(rows))
    monkeypatch.setattr(generate, "SEEDS", data)
    shown = generate.seeds_table("causal").splitlines()
    assert shown[0] == "| figure | trajectron | cab | cab − trajectron | 95 % interval |"
    (line,) = [one for one in shown if one.startswith("| FDE-ML 6 s |")]
    assert line.startswith("| FDE-ML 6 s | 8.500 ± 0.707 | 7.250 ± 0.354 | -1.250 |")
    beside = generate.paper_table("causal").splitlines()
    (line,) = [one for one in beside if one.startswith("| trajectron |")]
    assert " (10.45) " in line  # the bundled training, beside the paper
    (line,) = [one for one in beside if one.startswith("| trajectron, 2 trainings |")]
    assert " 8.50 ± 0.71 " in line
    assert line.endswith("| – |")  # they have no figure of the hardest pairs


def test_kept_runs_give_the_same_comparison(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    runs = trainings(tmp_path / "runs")
    kept = [tmp_path / "kept" / run.name for run in runs]
    for run, folder in zip(runs, kept, strict=True):
        keep(run, folder)
    names = ("trajectron", "cab")
    assert with_comparison({}, kept, names) == with_comparison({}, runs, names)
    assert with_comparison({}, [kept[0], runs[1]], names) == with_comparison({}, runs, names)


def test_a_run_without_figures_by_scenes_is_not_kept(tmp_path: Path) -> None:
    (run, _) = trainings(tmp_path)
    (run / "instances.npz").unlink()
    with pytest.raises(ValueError, match="does not hold ade_ml_6s_m"):
        keep(run, tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


def test_trainings_on_a_part_of_the_pairs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="whole of train_val"):
        with_comparison({}, trainings(tmp_path, "train_fold"), ("trajectron", "cab"))
