"""A benchmark's figures as rules that Prometheus reads."""

import math
from dataclasses import replace
from typing import Any

import yaml

from benchmark.prometheus_rules import RULES_FILE, rules
from benchmark.results import BenchmarkResults
from model.forecaster import Protocol
from tests.benchmark.builders import made_metrics, made_model, made_oracle, made_results
from tests.deploy.files import PROMETHEUS, read_yaml


def read(results: BenchmarkResults) -> list[dict[str, Any]]:
    [group] = yaml.safe_load(rules(results))["groups"]
    assert group["name"] == "benchmark"
    found: list[dict[str, Any]] = group["rules"]
    return found


def test_two_rules_for_each_served_model() -> None:
    found = read(
        made_results(made_model("cab"), made_model("kalman", metrics=made_metrics(1.5)), made_oracle())
    )
    assert found == [
        _dispersion("cab", "2.00"),
        _dispersion("kalman", "3.00"),
        _convergence("cab", "1.00"),
        _convergence("kalman", "0.67"),
    ]


def test_what_was_not_measured_is_not_compared_with() -> None:
    metrics = made_metrics() | {"convergence_1m_s": math.nan}
    del metrics["dispersion_std_m"]
    assert read(made_results(made_model("cab", metrics=metrics), made_model("kalman"))) == [
        _dispersion("kalman", "2.00"),
        _convergence("kalman", "1.00"),
    ]


def test_live_figures_do_not_tell_versions_apart() -> None:
    old, new = made_model("cab", "1.0.0"), made_model("cab", "1.1.0", metrics=made_metrics(2.0))
    paper = made_model("cab", "2.0.0+paper", "paper", made_metrics(3.0))
    for models in ((old, new), (new, old), (new, paper, old)):
        assert read(made_results(*models)) == [_dispersion("cab", "4.00"), _convergence("cab", "0.50")]


def test_without_any_figure_there_is_no_file() -> None:
    assert rules(made_results(made_model("cab", metrics={"nll": 1.0}), made_oracle())) == ""


def test_what_live_figures_cannot_be_compared_with_is_in_no_file() -> None:
    assert rules(made_results(protocol=Protocol.PAPER)) == ""
    assert rules(replace(made_results(), limit=5)) == ""


def test_it_says_what_it_is_of() -> None:
    results = made_results()
    assert results.statement() in rules(results)


def test_it_may_take_the_place_of_what_is_deployed() -> None:
    deployed = read_yaml(PROMETHEUS / RULES_FILE)["groups"]
    made = yaml.safe_load(rules(made_results(made_model("cab"))))["groups"]
    assert [{**group, "rules": None} for group in made] == [{**group, "rules": None} for group in deployed]
    for rule in made[0]["rules"]:
        assert [one for one in deployed[0]["rules"] if {**one, "expr": rule["expr"]} == rule]


def _dispersion(model: str, value: str) -> dict[str, Any]:
    record = "forecast:benchmark_dispersion_meters"
    return {"record": record, "labels": {"model": model}, "expr": f"vector({value})"}


def _convergence(model: str, value: str) -> dict[str, Any]:
    record = "forecast:benchmark_convergence_seconds"
    return {"record": record, "labels": {"model": model, "tau": "1"}, "expr": f"vector({value})"}
