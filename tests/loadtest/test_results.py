"""Outcomes of calls, and reports of them."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cab.forecast.v1.prediction_service_pb2 import PredictResponse
from loadtest.generator import Call, Calls, Load
from loadtest.report import Report
from loadtest.requests import Encoding, ForwardInProcess, made_up_requests, scene_of
from loadtest.results import Result, Usage
from model.registry import Registry

BEFORE = Usage(10.0, 1.0, 100 * 2**20, 20, 10, 0, {"late": 3.0, "queue_full": 0.0})
AFTER = Usage(12.0, 2.5, 110 * 2**20, 21, 10, 0, {"late": 5.0, "queue_full": 0.0})


def result(codes: Sequence[tuple[str, float]], deadline: float | None = 1.0, **changes: Any) -> Result:
    """A result of calls of those codes and latencies, scheduled a tenth of a second apart."""
    calls = [
        Call(0, number / 10, number / 10 + 0.001, number / 10 + seconds, code)
        for number, (code, seconds) in enumerate(codes)
    ]
    load = Load(np.arange(len(calls)) / 10, len(calls) / 10, deadline)
    return replace(Result("made up", Calls(load, calls, 2.0, 0.1), BEFORE, AFTER, peak=2.0), **changes)


def test_calls_are_counted_by_outcome() -> None:
    made = result(
        [
            ("OK", 0.5),
            ("OK", 1.5),
            ("RESOURCE_EXHAUSTED", 0.02),
            ("RESOURCE_EXHAUSTED", 0.03),
            ("DEADLINE_EXCEEDED", 1.0),
            ("UNAVAILABLE", 0.1),
            ("CANCELLED", 0.1),
        ]
    )
    assert made.counts == {"in time": 1, "late": 2, "refused": 2, "lost": 1, "cancelled": 1}
    assert (made.offered, made.accepted) == (7, 5)
    assert made.goodput == 0.5
    assert made.ratio == 0.25
    assert made.longest_refusal == pytest.approx(0.029)
    assert made.latency(0.5) == pytest.approx(1.0)
    assert made.refused_by_reason == {"late": 2, "queue_full": 0}
    assert made.server_cpu == 0.75
    assert made.failures == ["made up: 1 calls lost (1 UNAVAILABLE)"]


def test_without_a_deadline_no_answer_is_late() -> None:
    made = result([("OK", 100.0)], None)
    assert made.counts == {"in time": 1}
    assert not made.failures
    assert math.isnan(made.longest_refusal)


def test_a_report_tells_everything(tmp_path: Path) -> None:
    good = result([("OK", 0.5), ("RESOURCE_EXHAUSTED", 0.02)])
    bad = result([("OK", 0.5)], name="<bad>", wrong=["vehicle-0: off by 1 m"], problems=["a probe failed"])
    report = Report("Load test", ["two cores"], [good, bad], ["raw forward: 9 calls/s"])
    assert len(report.failures) == 2
    text = report.markdown()
    for part in (
        "| made up | 1000 ms | 10.0 | 2 | 1 | 1 | 1 (late 2) |",
        "100 → 110",
        "raw forward",
        "off by",
    ):
        assert part in text
    report.write(tmp_path)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<svg" in page
    assert "&lt;bad&gt;" in page
    assert not Report("Load test", [], [good], []).failures


@pytest.mark.parametrize("encoding", Encoding)
def test_answers_are_compared_with_the_forward(tmp_path: Path, encoding: Encoding) -> None:
    requests = made_up_requests("kalman", 3, encoding, scenes=1)
    forward = ForwardInProcess(tmp_path, "kalman", requests)
    scene = scene_of(requests[0].message, 5)
    mixture = Registry.load(None).get("kalman")(scene, np.arange(3))
    answer = PredictResponse()
    for row, agent in enumerate(requests[0].message.agents):
        forecast = answer.forecasts.add(agent_id=agent.id, weights=[1.0])
        forecast.means.extend(mixture.world_means[row].flatten().tolist())
        covariances = mixture.covariances[row].double().numpy()
        forecast.covariances.extend(covariances[..., [0, 0, 1], [0, 1, 1]].ravel().tolist())

    def fault() -> str:
        if encoding is Encoding.PROTOBUF:
            return forward.fault(0, answer.SerializeToString(), encoding)
        from google.protobuf.json_format import MessageToJson

        return forward.fault(0, MessageToJson(answer).encode(), encoding)

    assert fault() == ""
    answer.forecasts[1].means[5] += 0.01
    assert fault().startswith("vehicle-1: off by 0.01 m")
    answer.forecasts[1].means[5] = math.nan
    assert fault().startswith("vehicle-1: off by nan m")
    del answer.forecasts[1].means[5]
    assert "too few" in fault()
    del answer.forecasts[2]
    assert fault() == "the answer is of other agents"
    assert "cannot be parsed" in forward.fault(0, b"\xff", encoding)


def test_the_raw_forward_has_a_rate(tmp_path: Path) -> None:
    forward = ForwardInProcess(tmp_path, "kalman", made_up_requests("kalman", 64, scenes=1))
    assert forward.best_rate("onnxruntime", 1, 0.01) > 0
