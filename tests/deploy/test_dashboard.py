"""The Grafana dashboard uses only metrics that the server exports."""

import json
import re
from itertools import combinations
from typing import Any

import pytest

from tests.deploy.files import DEPLOY
from tests.deploy.promql import labels_of
from tests.deploy.series import Series

DASHBOARD: dict[str, Any] = json.loads((DEPLOY / "grafana/cab-forecast.json").read_text(encoding="utf-8"))
PANELS = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]


def query_of(target: dict[str, str]) -> str:
    """Return the PromQL of a target, with a duration in place of Grafana's interval variables."""
    return re.sub(r"\[\$\w+\]", "[5m]", target["expr"])


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: panel["title"])
def test_a_panel_asks_for_what_there_is(panel: dict[str, Any], series: Series) -> None:
    assert panel["description"]
    for target in panel["targets"]:
        labels = labels_of(query_of(target), series)
        assert set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"])) <= labels.keys()


def test_only_variables_that_there_are_are_used() -> None:
    there = {variable["name"] for variable in DASHBOARD["templating"]["list"]} | {"__rate_interval", "__all"}
    assert set(re.findall(r"\$\{?(\w+)", json.dumps(DASHBOARD))) == there


def test_panels_do_not_cover_each_other() -> None:
    ids = [panel["id"] for panel in DASHBOARD["panels"]]
    assert len(ids) == len(set(ids))
    for one, other in combinations([panel["gridPos"] for panel in DASHBOARD["panels"]], 2):
        apart = any(
            one[at] + one[size] <= other[at] or other[at] + other[size] <= one[at]
            for at, size in (("x", "w"), ("y", "h"))
        )
        assert apart, (one, other)


def test_every_series_of_the_service_is_shown(series: Series) -> None:
    asked = json.dumps([panel["targets"] for panel in PANELS])
    exported = {name for name in series if name.startswith("forecast_")}
    families = {re.sub(r"_(bucket|count|sum|created)$", "", name) for name in exported}
    assert {name for name in families if name not in asked} == {"forecast_build_info", "forecast_model_info"}
