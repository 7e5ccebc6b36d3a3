"""What a benchmark measured of stability, as rules for Prometheus to compare live figures with.

Displacement errors are not among them: a checkpoint brings its own, and the server exports them.
"""

import json
import math
from collections.abc import Mapping
from typing import Final

from benchmark.models import oldest_first
from benchmark.results import ModelResult, Results
from model.forecaster import Protocol

RULES_FILE: Final = "benchmark.yml"
"""Of the same name as the file in ``deploy/prometheus/`` that it may take the place of."""
_FILE: Final = """\
# What a benchmark measured of each model's stability, for the rules in alerts.yml to compare with: the
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


def rules(results: Results) -> str:
    """The file; empty where there is nothing to compare with: live inputs are of the causal protocol, and
    figures of only the first pairs are no measure.

    Live figures do not tell versions of a model apart: the newest counts, which calls get that name none.
    """
    if results.protocol is not Protocol.CAUSAL or results.limit is not None:
        return ""
    asked = {one.key: one for one in results.models if one.version and one.protocol != Protocol.PAPER.value}
    models = {asked[key].name: asked[key] for key in oldest_first(asked)}
    dispersion = _rules(models, "forecast:benchmark_dispersion_meters", "dispersion_std_m")
    convergence = _rules(models, "forecast:benchmark_convergence_seconds", "convergence_1m_s", ', tau: "1"')
    if not dispersion + convergence:
        return ""
    return _FILE.format(statement=results.statement(), dispersion=dispersion, convergence=convergence)


def _rules(models: Mapping[str, ModelResult], record: str, figure: str, labels: str = "") -> str:
    """A rule for each model of which the figure is known."""
    values = {name: model.metrics.get(figure, math.nan) for name, model in models.items()}
    return "".join(
        _RULE.format(record=record, labels=f"model: {json.dumps(name)}{labels}", value=value)
        for name, value in values.items()
        if math.isfinite(value)
    )
