"""Explanations: requests, tables and plots."""

import io
from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from cab.forecast.v1 import explanation_service_pb2 as pb
from cab.forecast.v1 import prediction_service_pb2 as predict_pb
from cab.forecast.v1.model_service_pb2 import INPUT_PROTOCOL_CAUSAL, ModelReference
from cab_forecast import agent, as_explain_request, demo_request, explain_options, explain_request
from cab_forecast.explain_plot import MAX_ROWS, Explained, plot_explanations
from cab_forecast.explanations import print_explanations

MODEL = ModelReference(name="fan", version="1.0.0", protocol=INPUT_PROTOCOL_CAUSAL)


def answer(request: predict_pb.PredictRequest) -> pb.ExplainResponse:
    """Return made-up explanations of a request's agents; the last one is invalid."""
    response = pb.ExplainResponse(
        model=MODEL, time=request.time, horizon=6.0, forecasts=57, warnings=["beware"]
    )
    for number, one in enumerate(request.agents):
        explanation = response.explanations.add(
            agent_id=one.id,
            status=predict_pb.FORECAST_STATUS_OK,
            model=MODEL,
            baseline=pb.EXPLANATION_BASELINE_DONORS,
            draws=8,
            end_point=pb.Position(x=one.states[-1].x + 30, y=one.states[-1].y),
            base_point=pb.Position(x=one.states[-1].x + 10, y=one.states[-1].y),
            state=pb.ShapleyValue(nearer=15.25, nearer_error=1.5),
            map=pb.ShapleyValue(nearer=-number),
            neighbors=pb.ShapleyValue(nearer=5.0),
        )
        explanation.by_neighbor.add(agent_id="the-other", value=pb.ShapleyValue(nearer=4.0))
        explanation.by_neighbor.add(agent_id="nobody", value=pb.ShapleyValue())
    last = response.explanations[-1]
    last.status, last.detail, last.field = predict_pb.FORECAST_STATUS_INVALID, "it jumps", "agents[1]"
    return response


def predicted(request: predict_pb.PredictRequest) -> predict_pb.PredictResponse:
    """Return made-up forecasts of a request's agents, straight ahead."""
    response = predict_pb.PredictResponse(model=MODEL, time=request.time, steps=12, step=0.5)
    for one in request.agents:
        now = one.states[-1]
        forecast = response.forecasts.add(
            agent_id=one.id, status=predict_pb.FORECAST_STATUS_OK, model=MODEL, mode_ids=[0], weights=[1.0]
        )
        for step in range(1, 13):
            forecast.means.extend((now.x + 2.5 * step, now.y))
            forecast.covariances.extend((0.1 * step, 0.0, 0.1 * step))
    return response


def test_a_request_from_scratch() -> None:
    car = agent("car", "vehicle", [0.0, 0.5], [(0, 0), (2, 0)])
    options = explain_options(by_neighbor=True, draws=4, permutations=32, seed=7, horizon=3.0)
    request = explain_request(0.5, [car], model="cab", options=options)
    assert (request.time, request.model, request.agents[0].id) == (0.5, "cab", "car")
    assert not request.HasField("scene_raster")
    assert request.options == pb.ExplainOptions(
        by_neighbor=True, draws=4, permutations=32, seed=7, horizon=3.0
    )
    null = explain_options(baseline="null_context")
    assert null.baseline == pb.EXPLANATION_BASELINE_NULL_CONTEXT
    assert not null.HasField("horizon")
    with pytest.raises(ValueError, match="donors, null_context"):
        explain_options(baseline="nothing")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="-1"):
        explain_options(draws=-1)


def test_a_request_from_that_of_a_forecast() -> None:
    request = demo_request()
    request.model = "cab"
    request.options.horizon = 2.0
    explain = as_explain_request(request)
    assert list(explain.agents) == list(request.agents)
    assert explain.scene_raster == request.scene_raster
    assert (explain.time, explain.model, explain.options.horizon) == (request.time, "cab", 2.0)
    assert not as_explain_request(request, pb.ExplainOptions()).options.HasField("horizon")
    assert not as_explain_request(predict_pb.PredictRequest()).HasField("time")


def test_the_table_has_values_errors_and_reasons() -> None:
    request = demo_request()
    out = io.StringIO()
    print_explanations(answer(request), Console(file=out, width=150))
    lines = out.getvalue().splitlines()
    first = next(line for line in lines if request.agents[0].id in line)
    assert first.split() == [
        *(request.agents[0].id, "+15.25", "±", "1.50", "+0.00", "+5.00", "+20.25", "8", "donors")
    ]
    assert any("the-other" in line and "+4.00" in line for line in lines)
    assert not any("nobody" in line for line in lines)
    assert f"{request.agents[-1].id}: INVALID: it jumps" in lines
    assert "fan@1.0.0, causal protocol, 57 forecasts" in lines
    assert "warning: beware" in lines


def test_the_plot_has_a_row_for_each_agent_and_a_column_for_each_model(tmp_path: Path) -> None:
    request = demo_request()
    request.ClearField("scene_raster")  # it takes seconds to draw
    del request.agents[3:]
    one = Explained(request, predicted(request), answer(request))
    sizes = []
    for columns in (1, 2):
        file = tmp_path / f"{columns}.png"
        plot_explanations([[one] * columns], file, labels=["a", "b"][:columns])
        with Image.open(file) as image:
            sizes.append(image.size)
    assert sizes[1][0] == 2 * sizes[0][0]
    plot_explanations([[one], [one]], tmp_path / "rows.png")  # two scenes of two explained agents each
    with Image.open(tmp_path / "rows.png") as image:
        assert image.size[1] > 1.5 * sizes[0][1]
    assert MAX_ROWS >= 4


def test_nothing_to_plot_is_refused(tmp_path: Path) -> None:
    request = demo_request()
    none = Explained(request, predicted(request), pb.ExplainResponse(model=MODEL))
    with pytest.raises(ValueError, match="nothing to plot"):
        plot_explanations([[none]], tmp_path / "none.png")
