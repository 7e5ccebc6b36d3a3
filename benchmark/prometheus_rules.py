"""Recording rules for Prometheus: the benchmark's temporal consistency, to compare live figures with.

Displacement errors are not included: a checkpoint holds its own, and the server exports them.
"""

import json
import math
from collections.abc import Mapping
from typing import Final

from benchmark.models import oldest_first
from benchmark.results import BenchmarkModelResult, BenchmarkResults
from model.forecaster import Protocol

RULES_FILE: Final = "benchmark.yml"
"""Name of the file, as in ``deploy/prometheus/``, which it may replace."""
_FILE: Final = """\
# Temporal consistency of each model in a benchmark, for the rules in alerts.yml to compare with: the
# columns "D, std" and "C(1 m)" of its tables. Written by `cab-forecast benchmark`. Displacement errors are on
# the models' cards, and exported by the server itself (forecast_benchmark_displacement_error_meters).
#
# {statement}
groups:
  - name: benchmark
    interval: 1m
    rules:
      # Dispersion: standard deviation of the distances to the barycentre, m
{dispersion}\
      # Convergence: since when all forecasts had been within 1 m of what was observed, s
{convergence}"""
_RULE: Final = """\
      - record: {record}
        labels: {{{labels}}}
        expr: vector({value:.2f})
"""


def rules(results: BenchmarkResults) -> str:
    """Return the text of the file; empty if live figures cannot be compared with the results.

    Live inputs follow the causal protocol, and figures of a limited number of pairs are not representative.
    Live figures do not distinguish the versions of a model: the newest is used, as for calls without a
    version.
    """
    if results.protocol is not Protocol.CAUSAL or results.limit is not None:
        return ""
    requested = {
        one.key: one for one in results.models if one.version and one.protocol != Protocol.PAPER.value
    }
    models = {requested[key].name: requested[key] for key in oldest_first(requested)}
    dispersion = _rules(models, "forecast:benchmark_dispersion_meters", "dispersion_std_m")
    convergence = _rules(models, "forecast:benchmark_convergence_seconds", "convergence_1m_s", ', tau: "1"')
    if not dispersion + convergence:
        return ""
    return _FILE.format(statement=results.statement(), dispersion=dispersion, convergence=convergence)


def _rules(models: Mapping[str, BenchmarkModelResult], record: str, figure: str, labels: str = "") -> str:
    """Return a rule for each model whose figure is known."""
    values = {name: model.metrics.get(figure, math.nan) for name, model in models.items()}
    return "".join(
        _RULE.format(record=record, labels=f"model: {json.dumps(name)}{labels}", value=value)
        for name, value in values.items()
        if math.isfinite(value)
    )
