"""The Prometheus rules use only metrics that the server exports."""

import json
import re

import pytest

from tests.deploy.files import PROMETHEUS, ROOT, read_yaml, rules
from tests.deploy.promql import QueryError, labels_of
from tests.deploy.series import Series

ALERTS = {rule["alert"]: rule for rule in rules("alerts.yml") if "alert" in rule}
_NO_MEANING = {"le"}
"""Labels whose values are numbers, which Prometheus 2 and 3 format differently."""


def test_all_rule_files_are_loaded() -> None:
    loaded = read_yaml(PROMETHEUS / "prometheus.yml")["rule_files"]
    assert loaded == ["benchmark.yml", "alerts.yml"]
    assert {file.name for file in PROMETHEUS.glob("*.yml")} == {*loaded, "alerts_test.yml", "prometheus.yml"}
    tests = read_yaml(PROMETHEUS / "alerts_test.yml")
    assert tests["rule_files"] == loaded


@pytest.mark.parametrize("rule", rules("alerts.yml"), ids=lambda rule: rule.get("alert", rule.get("record")))
def test_a_rule_asks_for_what_there_is(rule: dict[str, str], series: Series) -> None:
    labels_of(rule["expr"], series)


@pytest.mark.parametrize("name", ALERTS)
def test_an_alert_says_what_it_is_and_what_to_look_at(name: str, series: Series) -> None:
    rule = ALERTS[name]
    assert rule["for"]
    assert rule["labels"] == {"severity": rule["labels"]["severity"]}
    assert rule["labels"]["severity"] in {"warning", "critical"}
    notes = rule["annotations"]
    assert notes.keys() == {"summary", "description", "runbook"}
    assert re.search(r"\d", notes["description"]), "no number"
    used = {label for text in notes.values() for label in re.findall(r"\$labels\.(\w+)", text)}
    assert used <= labels_of(rule["expr"], series).keys() - _NO_MEANING


@pytest.mark.parametrize("name", ALERTS)
def test_an_alert_has_a_test_in_which_it_fires_and_one_in_which_it_does_not(name: str) -> None:
    tests = [
        one for test in read_yaml(PROMETHEUS / "alerts_test.yml")["tests"] for one in test["alert_rule_test"]
    ]
    fires = {bool(one.get("exp_alerts")) for one in tests if one["alertname"] == name}
    assert fires == {True, False}


@pytest.mark.parametrize("name", ALERTS)
def test_an_alert_is_explained(name: str) -> None:
    assert f"| `{name}` |" in (ROOT / "deploy/README.md").read_text()


@pytest.mark.parametrize(
    ("record", "figure"),
    [
        ("forecast:benchmark_dispersion_meters", "dispersion_std"),
        ("forecast:benchmark_convergence_seconds", "convergence_1"),
    ],
)
def test_alerts_compare_with_the_documented_benchmark_figures(record: str, figure: str) -> None:
    rows = json.loads((ROOT / "docs/data/benchmark_train_val.json").read_text())["consistency_causal"]
    measured = {row["model"]: row[figure] for row in rows}
    del measured["physics-oracle"]  # is not served
    ours = {
        rule["labels"]["model"]: float(rule["expr"].removeprefix("vector(").removesuffix(")"))
        for rule in rules("benchmark.yml")
        if rule["record"] == record
    }
    assert ours == measured


@pytest.mark.parametrize(
    ("query", "wrong"),
    [
        ("forecast_request_total", "there is no metric"),
        ('forecast_requests_total{status="OK"}', "there is no label status"),
        ('forecast_requests_total{code="429"}', "code of forecast_requests_total is never 429"),
        ('forecast_track_store_seconds_count{op=~"exchange|swap"}', "op of .* is never"),
        ("sum by (model) (forecast_queue_agents)", "there is no label model"),
        (
            "forecast_dispersion_meters_sum / on (tau) forecast_convergence_seconds_sum",
            "there is no label tau",
        ),
        ("histogram_quantile(0.5, forecast_queue_seconds_sum)", "there is no label le"),
        ("sum by (code) (sum(forecast_requests_total))", "there is no label code"),
    ],
)
def test_a_query_for_what_there_is_not_is_found(query: str, wrong: str, series: Series) -> None:
    with pytest.raises(QueryError, match=wrong):
        labels_of(query, series)
