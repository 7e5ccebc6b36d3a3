"""Foxglove's messages of a call."""

import math

import numpy as np
import pytest
from google.protobuf.timestamp_pb2 import Timestamp

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.scenes.scene import Raster
from service.recording.frames import agents_frame
from service.recording.map_grid import map_grid
from service.recording.scene_update import scene_update
from service.tracking.store.records import OBSERVATION_FIELDS
from tests.service.recording.calls import answered


def test_a_cell_lies_where_the_pixel_does() -> None:
    """Row i, column j of a raster is the middle of the grid's cell of column i and row j."""
    layers = np.zeros((3, 4, 6), dtype=np.uint8)
    layers[0, 1, :] = 1
    layers[1, 3, 5] = 1
    grid = map_grid(Raster(layers, np.array([100.0, 200.0]), 2.0), Timestamp())
    cells = np.frombuffer(grid.data, dtype=np.uint8).reshape(-1, grid.row_stride // 4, 4)
    assert grid.column_count == 4
    assert cells.shape == (6, 4, 4)
    np.testing.assert_array_equal(cells[..., 3] > 0, layers.any(axis=0).T)
    corner = np.array([grid.pose.position.x, grid.pose.position.y])
    size = np.array([grid.cell_size.x, grid.cell_size.y])
    middle = corner + size * (np.array([3, 5]) + 0.5)
    np.testing.assert_allclose(middle, np.array([100.0, 200.0]) + np.array([3, 5]) / 2.0)


@pytest.mark.parametrize("shape", [(2000, 1501), (1025, 1024), (4, 300_001)])
def test_a_large_map_keeps_its_dividers(shape: tuple[int, int]) -> None:
    rows, columns = shape
    layers = np.zeros((3, rows, columns), dtype=np.uint8)
    layers[2, rows // 2, columns - 1] = 1
    grid = map_grid(Raster(layers, np.zeros(2), 3.0), Timestamp())
    cells = np.frombuffer(grid.data, dtype=np.uint8).reshape(-1, grid.column_count, 4)
    assert cells.shape[0] * cells.shape[1] <= 2**20 + rows + columns
    [[row, column]] = np.argwhere(cells[..., 3] > 0).tolist()
    assert column * grid.cell_size.x == pytest.approx(rows // 2 / 3.0, abs=grid.cell_size.x)
    assert row * grid.cell_size.y == pytest.approx((columns - 1) / 3.0, abs=grid.cell_size.y)


def test_the_likely_modes_are_drawn_from_where_the_agent_is() -> None:
    call = answered(agents=1)
    [forecast] = call.response.forecasts
    [entity] = scene_update(call).entities
    [cube] = entity.cubes
    now = call.request.agents[0].states[-1]
    assert (cube.pose.position.x, cube.pose.position.y) == (now.x, now.y)
    drawn = [weight for weight in forecast.weights if weight >= 0.05]
    history, *modes = entity.lines
    assert len(modes) == len(drawn) > 1
    assert [mode.thickness for mode in modes] == sorted((mode.thickness for mode in modes), reverse=True)
    path = [
        (point.x + mode.pose.position.x, point.y + mode.pose.position.y)
        for mode in modes[:1]
        for point in mode.points
    ]
    np.testing.assert_allclose(path[0], (now.x, now.y))
    np.testing.assert_allclose(np.ravel(path[1:]), forecast.means[: 2 * call.response.steps])
    first = [(point.x + history.pose.position.x, point.y) for point in history.points]
    np.testing.assert_allclose(np.array(first)[:, 0], [state.x for state in call.request.agents[0].states])


def test_an_ellipse_holds_ninety_percent() -> None:
    call = answered(agents=1)
    [forecast] = call.response.forecasts
    del forecast.covariances[:]
    forecast.covariances.extend([4.0, 0.0, 1.0] * (len(forecast.weights) * call.response.steps))
    [entity] = scene_update(call).entities
    sizes = {(round(ellipse.size.x, 3), round(ellipse.size.y, 3)) for ellipse in entity.cylinders}
    quantile = math.sqrt(-2 * math.log(0.1))
    assert sizes == {(round(2 * 2 * quantile, 3), round(2 * quantile, 3))}
    for ellipse in entity.cylinders:
        assert abs(ellipse.pose.orientation.z) == pytest.approx(0.0, abs=1e-9) or abs(
            ellipse.pose.orientation.w
        ) == pytest.approx(0.0, abs=1e-9)  # the longer axis lies along x


def test_a_recalled_history_is_drawn() -> None:
    row = np.full((3, OBSERVATION_FIELDS), np.nan)
    row[:, :3] = [[0.0, -5.0, 1.0], [0.5, -2.5, 1.0], [1.0, 0.0, 1.0]]
    call = answered(agents=1, histories={"a0": row.tobytes()})
    [entity] = scene_update(call).entities
    assert len(entity.lines[0].points) == 3


def test_what_cannot_be_drawn_is_left_out() -> None:
    call = answered(agents=3)
    call.request.agents[0].states[-1].x = math.nan
    del call.request.agents[1].states[:]
    entities = scene_update(call).entities
    assert [entity.id for entity in entities] == ["/a2"]
    frame = agents_frame(call)
    assert frame is not None
    assert frame.translation.y == call.request.agents[2].states[-1].y
    del call.request.agents[:]
    assert agents_frame(call) is None


def test_an_invalid_agent_has_no_forecast() -> None:
    call = answered(agents=1)
    del call.response.forecasts[:]
    call.response.forecasts.add(agent_id="a0", status=pb.FORECAST_STATUS_INVALID, detail="why")
    [entity] = scene_update(call).entities
    assert not entity.cylinders
    assert {pair.key: pair.value for pair in entity.metadata}["detail"] == "why"
