import json
import math
from dataclasses import replace

import pytest

from model.evaluation.published import PUBLISHED
from model.evaluation.results import Row
from model.evaluation.tables import markdown, tables
from model.evaluation.text_tables import Table
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
    found = cells(titled(tables(results(CAB)), "likely"))
    assert (found["model"], found["ADE 6 s"], found["ADE 1 s"], found["OffR"]) == ("cab", "3.00", "-", "0.12")
    assert cells(titled(tables(results(CAB)), "whole"))["NLL"] == "inf"


def test_the_context_by_hand() -> None:
    alone = row("trajectron-no-context", ade_ml_6s_m=4.0, fde_ml_6s_m=9.0)
    kalman = row("kalman", learned=False, ade_ml_6s_m=4.0, fde_ml_6s_m=9.0)
    table = titled(tables(results(kalman, CAB, alone, ablate=True)), "context")
    assert cells(table) == {
        "model": "cab",
        "ADE": "3.00",
        "ADE, no map": "+0.30 (+10.0 %)",
        "ADE, no neighbours": "-0.03 (-1.0 %)",
        "ADE, neither": "+3.00 (+100.0 %)",
        "FDE": "8.00",
        "FDE, no map": "+0.20 (+2.5 %)",
        "FDE, no neighbours": "+0.00 (+0.0 %)",
        "FDE, neither": "+8.00 (+100.0 %)",
    }
    assert table.rows[1] == ("trajectron-no-context", "4.00", "-", "-", "-", "9.00", "-", "-", "-")
    assert len(table.rows) == 2
    assert "context" not in "".join(table.title for table in tables(results(CAB)))


def test_the_papers_figures_stand_beside_ours() -> None:
    oracle = row("physics-oracle", learned=False, ade_ml_6s_m=3.8)
    kalman = row("kalman", learned=False, ade_ml_6s_m=4.0)
    table = titled(tables(results(kalman, oracle, CAB)), "paper")
    assert [line[0] for line in table.rows] == ["physics-oracle", "cab"]
    oracles, cab = cells(table), cells(table, 1)
    assert (oracles["ADE"], oracles["ADE (paper)"], oracles["ADE-f (paper)"]) == ("3.80", "3.70", "-")
    assert (cab["FDE"], cab["FDE (paper)"], cab["OffR-f (paper)"]) == ("8.00", "8.02", "0.20")
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
    both: tuple[Row, ...] = (row("cab"), row("cab", version="1.1.0"), row("kalman", learned=False))
    names = [line[0] for line in titled(tables(results(*both)), "likely").rows]
    assert names == ["cab@1.0.0", "cab@1.1.0", "kalman"]


def test_json_has_null_for_what_is_not_finite() -> None:
    found = json.loads(results(CAB).to_json())
    assert found["protocol"] == "causal"
    assert found["rows"][0]["metrics"]["nll"] is None
    assert found["rows"][0]["ablated"]["map"]["ade_ml_6s_m"] == 3.3
