import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

from model.evaluation.published import PUBLISHED
from model.evaluation.results import RESULTS_FILE
from model.evaluation.tables import Table, markdown, tables
from tests.model.evaluation.builders import results, row

CAB = replace(
    row("cab", ade_ml_6s_m=3.0, fde_ml_6s_m=8.0, off_road_ml=0.125, nll=math.inf),
    ablated={
        "map": {"ade_ml_6s_m": 3.3, "fde_ml_6s_m": 8.2},
        "neighbors": {"ade_ml_6s_m": 2.97, "fde_ml_6s_m": 8.0},
        "both": {"ade_ml_6s_m": 6.0, "fde_ml_6s_m": 16.0},
    },
)


def cells(table: Table, row: int = 0) -> dict[str, str]:
    """A row by column."""
    return dict(zip(table.columns, table.rows[row], strict=True))


def titled(made: list[Table], word: str) -> Table:
    (found,) = (table for table in made if word in table.title)
    return found


def test_what_is_not_known_is_a_dash() -> None:
    found = cells(titled(tables(results(CAB)), "Displacement"))
    assert (found["model"], found["ADE 6 s"], found["ADE 1 s"], found["OffR"]) == (
        "cab@1.0.0",
        "3.00",
        "-",
        "0.12",
    )
    assert cells(titled(tables(results(CAB)), "Likelihood"))["NLL"] == "inf"


def test_the_context_by_hand() -> None:
    alone = row("trajectron-no-context", ade_ml_6s_m=4.0, fde_ml_6s_m=9.0)
    kalman = row("kalman", learned=False, ade_ml_6s_m=4.0, fde_ml_6s_m=9.0)
    table = titled(tables(results(kalman, CAB, alone, ablate=True)), "Context")
    assert cells(table) == {
        "model": "cab@1.0.0",
        "ADE": "3.00",
        "ADE, no map": "+0.30 (+10.0 %)",
        "ADE, no neighbours": "-0.03 (-1.0 %)",
        "ADE, neither": "+3.00 (+100.0 %)",
        "FDE": "8.00",
        "FDE, no map": "+0.20 (+2.5 %)",
        "FDE, no neighbours": "+0.00 (+0.0 %)",
        "FDE, neither": "+8.00 (+100.0 %)",
    }
    assert table.rows[1] == ("trajectron-no-context@1.0.0", "4.00", "-", "-", "-", "9.00", "-", "-", "-")
    assert len(table.rows) == 2
    assert "Context" not in "".join(table.title for table in tables(results(CAB)))


def test_the_papers_figures_stand_beside_ours() -> None:
    oracle = row("physics-oracle", learned=False, version="", ade_ml_6s_m=3.8)
    kalman = row("kalman", learned=False, ade_ml_6s_m=4.0)
    table = titled(tables(results(kalman, oracle, CAB)), "paper")
    assert [line[0] for line in table.rows] == ["physics-oracle"] * 3 + ["cab@1.0.0"] * 3
    (ours, oracles), (own, cab) = ((cells(table, first), cells(table, first + 1)) for first in (0, 3))
    assert (ours["ADE 6 s"], oracles["ADE 6 s"], oracles["ADE-f"]) == ("3.80", "3.70", "-")
    assert (own["FDE 6 s"], cab["FDE 6 s"], cab["OffR-f"]) == ("8.00", "8.02", "0.20")
    assert "paper protocol" in table.note
    assert not [table for table in tables(results(kalman)) if "paper" in table.title]


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_errors_grow_with_the_horizon(name: str) -> None:
    figures = PUBLISHED[name].figures()
    for kind in ("ade", "fde"):
        values = [figures[f"{kind}_ml_{second}s_m"] for second in range(1, 7)]
        assert values == sorted(values)
    assert figures["ade_ml_6s_m"] < figures["fde_ml_6s_m"]


def test_every_table_says_what_it_is_of() -> None:
    text = markdown(results(CAB, ablate=True))
    statement = "causal protocol, made split some, 10 pairs, 200 sampled trajectories a pair"
    assert text.count(statement) == 1 + len(tables(results(CAB, ablate=True)))
    assert "the first 10 pairs only" in replace(results(CAB), limit=10).statement()
    assert "no sampled trajectories" in results(CAB, samples=0).statement()
    widths = {line.count("|") for line in text.splitlines() if line.startswith("| cab")}
    assert widths == {line.count("|") for line in text.splitlines() if line.startswith("| ---")}


def test_two_versions_of_a_name_are_told_apart() -> None:
    both = (row("cab", nll=1.0), row("cab", version="1.1.0", nll=2.0), row("kalman", False, nll=3.0))
    names = [line[0] for line in titled(tables(results(*both)), "Likelihood").rows]
    assert names == ["cab@1.0.0", "cab@1.1.0", "kalman@1.0.0"]


def test_json_has_null_for_what_is_not_finite(tmp_path: Path) -> None:
    results(CAB).write(tmp_path)
    found = json.loads((tmp_path / RESULTS_FILE).read_text())
    assert found["protocol"] == "causal"
    assert found["rows"][0]["metrics"]["nll"] is None
    assert found["rows"][0]["ablated"]["map"]["ade_ml_6s_m"] == 3.3
