import math
from dataclasses import replace

import pytest

from benchmark.tables import left_out, markdown, tables
from model.evaluation.tables import Table
from model.forecaster import Protocol
from tests.benchmark.builders import all_models, made_metrics, made_model, made_oracle, made_results


def titled(made: list[Table], word: str) -> Table:
    (found,) = (table for table in made if word in table.title)
    return found


def cells(table: Table, row: int = 0) -> dict[str, str]:
    """A row by column."""
    return dict(zip(table.columns, table.rows[row], strict=True))


def without(*words: str) -> dict[str, float]:
    """All figures but those with one of the words in their names."""
    return {name: value for name, value in made_metrics().items() if not any(word in name for word in words)}


def test_every_table_says_what_it_is_of() -> None:
    results = replace(made_results(*all_models()), limit=10)
    made = tables(results)
    assert [table.title[:3].strip(" .") for table in made] == [
        *"1234",
        "4.1",
        "4.2",
        *"56",
        "7.1",
        "7.2",
        "7.3",
        "8",
        "9",
    ]
    statement = "causal protocol, made split some, the first 10 pairs only, seed 3"
    assert all(statement in table.note for table in made)
    [reason] = left_out(results)
    assert reason.startswith("10. What the forecasts owe")
    assert reason.endswith("(--explain)")
    assert markdown(results).count(statement) == 1 + len(made)


def test_figures_stand_in_their_columns() -> None:
    made = tables(made_results())
    first = cells(titled(made, "Displacement"))
    assert (first["model"], first["ADE 6 s"], first["FDE 2 s"]) == ("cab@1.0.0", "2.88", "0.80")
    assert (first["OffR"], first["ADE-f"], first["FDE-f"], first["OffR-f"]) == (
        "0.12",
        "3.50",
        "9.00",
        "0.25",
    )
    second = cells(titled(made, "2. Dispersion"))
    assert [second[name] for name in ("D, std", "D, mean", "D, rms")] == ["2.00", "3.00", "3.61"]
    assert [second[name] for name in ("C(0.2 m)", "C(1 m)", "C(5 m)")] == ["0.45", "1.00", "2.24"]
    assert second["instants"] == "30"
    assert titled(made, "3. Hard").rows == (("cab@1.0.0", "15.00", "14.00", "13.00", "7.20"),)
    modes = cells(titled(made, "Raw modes"))
    assert (modes["minADE_5"], modes["minFDE_10"], modes["miss rate 5"]) == ("0.60", "0.80", "0.20")
    assert titled(made, "Merged modes").rows == (
        (
            "cab@1.0.0",
            *("0.40", "0.20", "1.20", "0.60", "0.10", "0.05", "1.45", "3.00", "3.25", "0.62", "2.75", "7.00"),
        ),
    )
    moving = cells(titled(made, "Without standing agents"))
    assert (moving["FDE"], moving["minADE_5, raw"], moving["minADE_5, merged"]) == ("7.27", "0.61", "0.40")
    assert (moving["OffR-f"], moving["hold 90 %, median"]) == ("0.25", "4.00")
    likely = cells(titled(made, "Likelihood"))
    assert (likely["NLL"], likely["NLL 3 s"], likely["inside 90 %"]) == ("1.500", "1.500", "0.841")


def test_latency_is_in_milliseconds_and_has_no_oracle() -> None:
    table = titled(tables(made_results(made_model(), made_oracle())), "Latency")
    assert table.rows == (("cab@1.0.0", "40", "12.3", "34.5", "98.7", "1.1", "5.5", "7.2"),)


def test_the_use_of_the_context_has_a_row_for_each_set_of_pairs() -> None:
    table = titled(tables(made_results(made_model(), made_oracle())), "9. Use of the context")
    assert table.rows == (
        (
            "cab@1.0.0",
            "all",
            "10",
            "+1.25 (+0.50 … +2.00)",
            "-0.25 (-0.50 … +0.12)",
            "+0.50 (+0.25 … +0.75)",
            "+0.00 (-0.06 … +0.06)",
            "0.12 (0.00 … 0.25)",
            "0.75 (0.50 … 1.00)",
        ),
        ("cab@1.0.0", "turns after now", "3", "+7.50", "-", "-", "-", "-", "-"),
    )
    assert "FDE of trajectron-no-context@1.0.0 minus" in table.note
    assert "50 forecasts of each learned model; 100 of all took 12 s" in table.note


def test_pairs_by_status() -> None:
    odd = replace(made_model("odd"), statuses={"FALLBACK": 3, "SURPRISING": 7})
    some_lost = replace(made_model(), lost=2)
    table = titled(tables(made_results(some_lost, odd)), "statuses")
    assert cells(table) == {
        "model": "cab@1.0.0",
        "OK": "9",
        "SHORT_HISTORY": "0",
        "FALLBACK": "0",
        "INVALID": "0",
        "MISSING": "1",
        "SURPRISING": "0",
        "lost elsewhere": "2",
    }
    assert cells(table, 1)["SURPRISING"] == "7"
    assert cells(table, 1)["model"] == "odd@1.0.0 (3 of 10 by a fallback)"


@pytest.mark.parametrize(
    ("protocol", "inputs", "expected"),
    [
        ("causal", Protocol.CAUSAL, "cab@1.0.0"),
        ("causal", Protocol.PAPER, "cab@1.0.0 (trained causal)"),
        ("paper", Protocol.CAUSAL, "cab@1.0.0 (trained paper)"),
        ("any", Protocol.PAPER, "cab@1.0.0"),
    ],
)
def test_a_row_tells_of_states_unlike_the_training(protocol: str, inputs: Protocol, expected: str) -> None:
    model = made_model(protocol=protocol)
    assert model.label(inputs) == expected
    assert all(table.rows[0][0] == expected for table in tables(made_results(model, protocol=inputs)))


def test_the_papers_figures_stand_beside_ours() -> None:
    table = titled(tables(made_results(made_model(), made_model("kalman"))), "7.1")
    assert table.columns[:3] == ("model", "whose", "ADE 1 s")
    assert len(table.rows) == 3
    ours, paper, apart = (cells(table, row) for row in range(3))
    assert [one["whose"] for one in (ours, paper, apart)] == ["ours", "paper", "ours − paper"]
    assert (ours["FDE 6 s"], paper["FDE 6 s"], apart["FDE 6 s"]) == ("7.20", "8.02", "-0.82")
    assert (ours["OffR-f"], paper["OffR-f"], apart["OffR-f"]) == ("0.25", "0.20", "+0.05")


def test_the_papers_dispersion_stands_beside_both_forms() -> None:
    table = titled(tables(made_results()), "7.2")
    assert table.columns == ("model", "whose", "D, std", "D, mean", "C(0.2 m)", "C(1 m)", "C(5 m)")
    assert table.rows[1][2:] == ("2.61", "2.61", "1.12", "2.45", "4.74")
    assert table.rows[2][2:4] == ("-0.61", "+0.39")
    assert "compared with both" in table.note
    assert "compared with both" not in titled(tables(made_results()), "7.3").note


def test_the_papers_hard_cases_stand_beside_ours() -> None:
    table = titled(tables(made_results()), "7.3")
    assert table.rows[2] == ("cab@1.0.0", "ours − paper", "+2.87", "+2.12", "+1.41", "-0.82")


def test_what_the_paper_has_not_is_a_dash() -> None:
    table = titled(tables(made_results(made_model(), made_oracle())), "7.1")
    assert (cells(table, 4)["ADE-f"], cells(table, 5)["ADE-f"]) == ("-", "-")
    assert cells(table, 3)["ADE-f"] != "-"


def test_a_table_with_nothing_to_say_is_left_out_and_says_why() -> None:
    model = made_model("kalman", metrics=without("dispersion", "convergence", "hardest"))
    bare = replace(model, instants=0, latency=None, statuses={}, context={})
    results = replace(made_results(bare), consistency=False, context=None)
    assert [table.title[0] for table in tables(results)] == ["1", "4", "4", "4", "5"]
    reasons = left_out(results)
    assert len(reasons) == 9
    assert "9. Use of the context: left out: it was not measured (--context)" in reasons
    assert (
        "2. Dispersion and convergence: left out: forecasts for dispersion and convergence were not requested"
        in reasons
    )
    ranking = "kalman, whose errors rank the pairs, was not among the models"
    assert f"3. Hard cases: left out: {ranking}" in reasons
    assert any(reason.startswith("6. Latency: left out") for reason in reasons)
    assert all(f"- {reason}" in markdown(results) for reason in reasons)


def test_all_pairs_alone_are_no_hard_cases() -> None:
    model = made_model(metrics=without("hardest_1", "hardest_2", "hardest_3"))
    assert not [table for table in tables(made_results(model)) if table.title.startswith("3")]


def test_requested_but_never_complete() -> None:
    unknown = dict.fromkeys((name for name in made_metrics() if "dispersion" in name), math.nan)
    model = replace(made_model(metrics=without("dispersion", "convergence") | unknown), instants=0)
    assert [reason for reason in left_out(made_results(model)) if "every age" in reason]


def test_a_bar_in_a_name_does_not_break_the_table() -> None:
    text = markdown(made_results(made_model("c|b")))
    rows = [line for line in text.splitlines() if line.startswith(r"| c\|b")]
    heads = [line for line in text.splitlines() if line.startswith("| model")]
    assert rows
    assert rows[0].replace(r"\|", "").count("|") == heads[0].count("|")
