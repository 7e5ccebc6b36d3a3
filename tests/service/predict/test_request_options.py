"""Options and map of a request: what is valid is read, each fault names its field."""

from collections.abc import Callable

import numpy as np
import pytest

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.bounds import FIELD_BOUNDS, MAX_ID_LENGTH, MAX_PRIORITY
from model.forecaster import Context
from service.errors import BadField, TooLarge
from service.predict.request import Options, read_options, read_raster
from service.settings import Settings
from tests.service.fakes import FakeForecaster
from tests.service.requests import NOW, make_request, pack

INFO = FakeForecaster().info
SETTINGS = Settings(max_samples=10, max_samples_per_call=15, max_agents=3, max_raster_pixels=100)


def read(request: pb.PredictRequest) -> Options:
    return read_options(request, INFO, SETTINGS)


def test_defaults() -> None:
    assert read(make_request(2)) == Options(
        time=NOW,
        steps=12,
        context=Context.FULL,
        max_modes=0,
        merge=False,
        samples=0,
        seed=None,
        strict=False,
        predicted=2,
        scene_id="",
        recalls=False,
        priority=0,
        consistency=False,
    )


def test_priority() -> None:
    assert read(make_request(priority=MAX_PRIORITY)).priority == MAX_PRIORITY
    with pytest.raises(BadField, match=f"options.priority: must be at most {MAX_PRIORITY}"):
        read(make_request(priority=MAX_PRIORITY + 1))


def test_everything_given() -> None:
    request = make_request(
        3,
        context=pb.CONTEXT_BLIND,
        max_modes=4,
        merge=True,
        samples=5,
        seed=0,
        strict=True,
        horizon=2.5,
        history=pb.HISTORY_SOURCE_MEMORY,
        priority=2,
        consistency=True,
    )
    request.scene_id = "s" * MAX_ID_LENGTH
    request.agents[1].predict = False
    assert read(request) == Options(
        time=NOW,
        steps=5,
        context=Context.BLIND,
        max_modes=4,
        merge=True,
        samples=5,
        seed=0,
        strict=True,
        predicted=2,
        scene_id=request.scene_id,
        recalls=True,
        priority=2,
        consistency=True,
    )


@pytest.mark.parametrize(("horizon", "steps"), [(0.5, 1), (3.0, 6), (6.0, 12)])
def test_steps_of_a_horizon(horizon: float, steps: int) -> None:
    assert read(make_request(1, horizon=horizon)).steps == steps


@pytest.mark.parametrize(
    ("change", "field", "detail"),
    [
        (lambda r: r.ClearField("time"), "time", "is required"),
        (lambda r: setattr(r, "time", float("nan")), "time", "must be a finite number"),
        (lambda r: setattr(r, "time", 1.001e10), "time", "must be within -1e+10 … 1e+10"),
        (lambda r: setattr(r, "scene_id", "s" * 129), "scene_id", "has 129 characters; at most 128"),
        (lambda r: setattr(r.options, "context", 9), "options.context", "unknown value 9"),
        (lambda r: setattr(r.options, "history", 9), "options.history", "unknown value 9"),
        (lambda r: setattr(r.options, "history", 2), "options.history", "needs a scene_id"),
        (lambda r: setattr(r.options, "consistency", True), "options.consistency", "needs a scene_id"),
        (lambda r: setattr(r.options, "samples", 11), "options.samples", "at most 10"),
        (lambda r: setattr(r.options, "samples", 8), "options.samples", "8 × 2 agents; at most 15 in a call"),
        (lambda r: setattr(r.options, "horizon", 0.7), "options.horizon", "must be a multiple of 0.5 s"),
        (lambda r: setattr(r.options, "horizon", 0.25), "options.horizon", "must be within 0.5 … 6"),
        (lambda r: setattr(r.options, "horizon", 6.5), "options.horizon", "must be within 0.5 … 6"),
        (lambda r: setattr(r.options, "horizon", float("inf")), "options.horizon", "must be a finite number"),
    ],
)
def test_faults(change: Callable[[pb.PredictRequest], None], field: str, detail: str) -> None:
    request = make_request(2)
    change(request)
    with pytest.raises(BadField) as caught:
        read(request)
    [fault] = caught.value.faults
    assert (fault.field, fault.detail) == (field, detail)


def test_samples_are_bounded_by_the_bytes_of_the_response() -> None:
    request = make_request(2, samples=6, horizon=3.0)
    size = 6 * 2 * 6 * 2 * 8
    assert read_options(request, INFO, Settings(max_response_bytes=size)).samples == 6
    with pytest.raises(BadField, match=r"options\.samples: 6 × 2 .* × 6 steps are 1152 bytes; at most 1151"):
        read_options(request, INFO, Settings(max_response_bytes=size - 1))


def test_a_model_without_blind_forecasts_refuses_them() -> None:
    request = make_request(1, context=pb.CONTEXT_BLIND)
    with pytest.raises(BadField, match=r"options\.context: fake has no blind forecast"):
        read_options(request, FakeForecaster(supports_blind=False).info, SETTINGS)


def test_too_many_agents() -> None:
    assert read(make_request(3)).predicted == 3
    with pytest.raises(TooLarge, match="4 agents; at most 3"):
        read(make_request(4))


def with_raster(rows: int = 4, columns: int = 6) -> pb.PredictRequest:
    request = make_request(1)
    raster = request.scene_raster
    raster.rows, raster.columns = rows, columns
    raster.origin_x, raster.origin_y, raster.pixels_per_meter = -10.0, 20.0, 3.0
    layers = np.zeros((3, rows, columns), dtype=np.uint8)
    layers[1, 2] = 1
    raster.image.packed_bits = pack(layers)
    return request


def test_raster() -> None:
    raster = read_raster(with_raster(), SETTINGS)
    assert raster is not None
    assert raster.layers.shape == (3, 4, 6)
    assert raster.layers.sum() == raster.layers[1, 2].sum() == 6
    assert (raster.origin.tolist(), raster.pixels_per_meter) == ([-10.0, 20.0], 3.0)
    assert read_raster(make_request(1), SETTINGS) is None


@pytest.mark.parametrize("name", ["origin_x", "origin_y", "pixels_per_meter"])
def test_numbers_of_a_raster(name: str) -> None:
    low, high = FIELD_BOUNDS[f"SceneRaster.{name}"]
    request = with_raster()
    for value in (low, high):
        setattr(request.scene_raster, name, value)
        assert read_raster(request, SETTINGS) is not None
    for value in (low - 1e-3, high + 1e-3 * abs(high), float("nan")):
        setattr(request.scene_raster, name, value)
        with pytest.raises(BadField, match=rf"^scene_raster\.{name}: must be"):
            read_raster(request, SETTINGS)
    request.scene_raster.ClearField(name)  # type: ignore[arg-type]
    with pytest.raises(BadField, match=rf"^scene_raster\.{name}: is required"):
        read_raster(request, SETTINGS)


@pytest.mark.parametrize("name", ["rows", "columns"])
def test_packed_bits_need_a_size(name: str) -> None:
    request = with_raster()
    request.scene_raster.ClearField(name)  # type: ignore[arg-type]
    with pytest.raises(BadField, match=rf"^scene_raster\.{name}: is required with packed_bits"):
        read_raster(request, SETTINGS)


def test_the_size_of_a_raster_is_bounded() -> None:
    assert read_raster(with_raster(10, 10), SETTINGS) is not None
    with pytest.raises(BadField, match=r"^scene_raster\.rows: 10 × 11 pixels; at most 100"):
        read_raster(with_raster(10, 11), SETTINGS)
