"""Plots of scenes and forecasts."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import cab_forecast.plot
from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab_forecast import agent, demo_request, forecasts, map_patch, predict_request
from cab_forecast.plot import DOTS_PER_INCH, LONG_SIDE, plot
from tests.cab_forecast.answers import answer


def drawn(request: PredictRequest, folder: Path) -> np.ndarray:
    """Return the pixels of the plot: [height, width, 3]."""
    path = folder / "picture.png"
    plot(request, answer(request), path)
    return np.asarray(Image.open(path).convert("RGB"))


def test_draws_the_demo(tmp_path: Path) -> None:
    pixels = drawn(demo_request(), tmp_path)
    assert pixels.shape[1] == LONG_SIDE * DOTS_PER_INCH
    assert 5 * DOTS_PER_INCH <= pixels.shape[0] <= (LONG_SIDE + 2) * DOTS_PER_INCH
    for color in (
        (0xD3, 0xD7, 0xDD),
        (0xD9, 0x9A, 0x1C),
        (0x1F, 0x5F, 0xAE),
        (0xC8, 0x37, 0x4A),
        (0x1D, 0x8A, 0x4B),
    ):
        assert (np.abs(pixels.astype(int) - color).max(axis=-1) <= 2).sum() > 50, color


def test_draws_odd_scenes(tmp_path: Path) -> None:
    """Far, standing and invalid agents, own patches, no map, many agents."""
    patch = map_patch(np.ones((3, 100, 100)))
    odd = [
        agent("still", "vehicle", [-0.5, 0.0], [[5, 5], [5, 5]], map_patch=patch),
        agent("own-map", "vehicle", [-0.5, 0.0], [[0, 0], [1, 1]], headings=[0.7, 0.7], map_patch=patch),
        agent("invalid", "unknown", 0.0, [[2, 9]]),
        agent("far", "cyclist", [-0.5, 0.0], np.array([[9e6, 9e6], [9e6, 9e6 + 1]])),
        *(agent(f"{n}", "pedestrian", [-0.5, 0.0], np.array([[n, 3], [n, 3.2]])) for n in range(30)),
    ]
    request = predict_request(0.0, odd, horizon=1.0)
    request.agents.add(id="nothing known")
    assert drawn(request, tmp_path).std() > 1


def test_only_far_agents(tmp_path: Path) -> None:
    pair = [agent(f"{x}", "vehicle", [-0.5, 0.0], np.array([[x, 0], [x, 0]])) for x in (-9e5, 9e5)]
    assert drawn(predict_request(0.0, pair), tmp_path).size


@pytest.mark.parametrize("suffix", ["svg", "pdf"])
def test_writes_other_formats(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"picture.{suffix}"
    plot(demo_request(), answer(demo_request()), path)
    assert path.stat().st_size > 1000


def test_nothing_to_draw(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="nothing to plot"):
        plot(PredictRequest(), answer(PredictRequest()), tmp_path / "x.png")


def test_without_matplotlib_there_is_a_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.axes", None)
    with pytest.raises(ModuleNotFoundError, match=r'pip install "cab-forecast\[plot\]"'):
        importlib.reload(cab_forecast.plot)


def test_a_long_forecast_is_shown_whole() -> None:
    request = predict_request(0.0, [agent("fast", "vehicle", [-0.5, 0.0], [[-15.0, 0.0], [0.0, 0.0]])])
    response = answer(request)
    (forecast,) = response.forecasts
    forecast.means[:] = [
        value for _ in forecast.weights for x in np.linspace(0, 185, 12) for value in (x, 1.0)
    ]
    low, high = cab_forecast.plot._view(list(request.agents), forecasts(response))
    assert low[0] < 0
    assert high[0] > 185


def test_agents_far_away_are_left_out_with_their_forecasts() -> None:
    places = {"a": 0.0, "b": 20.0, "c": 900.0}
    request = predict_request(
        0.0, [agent(name, "vehicle", [-0.5, 0.0], [[x, 0.0], [x, 0.0]]) for name, x in places.items()]
    )
    _, high = cab_forecast.plot._view(list(request.agents), forecasts(answer(request)))
    assert high[0] < 400
