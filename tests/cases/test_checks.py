"""Tests of the checks on forecasts with known quantities."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cab_forecast import Status
from cab_forecast.layers import decode_layers
from model.arrays import Floats
from model.baselines.physics import baselines
from tests.cases import checks, roads, scenes
from tests.cases.bands import readings
from tests.cases.case import Frame, Pose, Row
from tests.cases.checks import LocalForecast
from tests.cases.running import Served

HERE = Frame(np.array([120.0, -40.0]), 0.7)
AHEAD: Floats = 0.5 * np.arange(1.0, 13.0)
"""s."""
SCENARIOS = {one.name: one for one in scenes.all_rows()}


def _forecast(*paths: Floats, weights: list[float] | None = None, sigma: float = 0.01) -> LocalForecast:
    """Return a forecast whose modes have the given standard deviations, m."""
    count = len(paths)
    return LocalForecast(
        HERE,
        Status.OK,
        np.arange(count),
        np.array(weights or [1 / count] * count),
        np.stack(paths),
        np.tile(sigma**2 * np.eye(2), (count, 12, 1, 1)),
    )


def _straight(speed: float, bearing: float = 0.0) -> Floats:
    path: Floats = speed * AHEAD[:, None] * np.array([math.cos(bearing), math.sin(bearing)])
    return path


@pytest.mark.parametrize("mirrored", [False, True])
def test_frames_go_there_and_back(mirrored: bool) -> None:
    frame = Frame(np.array([3.0, 4.0]), 2.0, mirrored)
    points = np.random.default_rng(0).normal(size=(5, 7, 2))
    np.testing.assert_allclose(frame.to_ground(frame.to_local(points)), points, atol=1e-12)


@pytest.mark.parametrize("mirrored", [False, True])
def test_covariances_turn_as_points_do(mirrored: bool) -> None:
    frame = Frame(np.zeros(2), 2.0, mirrored)
    points = np.random.default_rng(1).normal(size=(50, 2)) * (3.0, 1.0)
    turned = frame.covariances_to_local(np.cov(points.T))
    np.testing.assert_allclose(turned, np.cov(frame.to_local(points).T), atol=1e-12)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_left_turn_is_one_wherever_the_scene_lies(mirrored: bool) -> None:
    scenario = SCENARIOS["left turn 0.6 rad"].at(Pose(100.0, 50.0, 2.5, mirrored))
    case = scenario.case()
    states = case.request.agents[0].states
    local = case.frame.to_local(np.array([[state.x, state.y] for state in states]))
    np.testing.assert_allclose(local[-1], 0.0, atol=1e-9)
    assert (local[:-1, 0] < 0).all()
    assert local[0, 1] > 1.0  # the origin of the turn lies to the left of the current heading


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("name", ["curve 42", "curve 62", "curve 78"])
def test_who_keeps_the_lane_stays_on_the_road(name: str, mirrored: bool) -> None:
    scenario = SCENARIOS[name].at(Pose(-300.0, 20.0, -2.0, mirrored))
    case = scenario.case()
    radius, x, y = float(name.split()[1]), *scenario.position
    lane = scenes.left_arc(np.array([0.0, y]), radius - y, x)
    path, _ = lane(scenario.facts.speed * AHEAD)
    local = Frame(scenario.position, 0.0).to_local(path)
    assert case.raster is not None
    kept = LocalForecast(
        case.frame, Status.OK, np.zeros(1, int), np.ones(1), local[None], np.zeros((1, 12, 2, 2))
    )
    assert checks.weight_on_road(kept, case.raster) == 1.0
    straight_on = LocalForecast(
        case.frame,
        Status.OK,
        np.zeros(1, int),
        np.ones(1),
        _straight(scenario.facts.speed)[None],
        np.zeros((1, 12, 2, 2)),
    )
    assert (
        checks.weight_on_road(straight_on, case.raster) == checks.share_on_road(straight_on, case.raster) == 0
    )


@pytest.mark.parametrize(("field", "scale", "behind"), [("map_patch", 3.0, 10), ("far_map_patch", 1.4, 14)])
def test_patches_show_the_road_around_the_car(field: str, scale: float, behind: int) -> None:
    road = roads.junction(2, 3.6, 5.0)
    scenario = SCENARIOS["junction in 22 m"]
    car = scenario.at(Pose(40.0, -7.0, 1.2)).case("patch").request.agents[0]
    shown = decode_layers(getattr(car, field).image, 100, 100)
    for row, column in ((0, 50), (behind, 50), (20, 30), (40, 60), (70, 85), (99, 3)):
        x, y = scenario.position + np.array([row - behind, column - 50]) / scale
        np.testing.assert_array_equal(shown[:, row, column], road(x, y))
    assert not shown[0].all()


def test_shares_are_those_of_the_weights() -> None:
    stands, goes = np.zeros((12, 2)), _straight(5.0)
    forecast = _forecast(stands, goes, _straight(5.0, math.pi), weights=[0.6, 0.3, 0.1])
    assert checks.share_moving(forecast, 2.0, 3.0) == pytest.approx(0.4, abs=0.03)
    assert checks.share_of_moving_ahead(forecast, 2.0, 3.0, 1.0) == pytest.approx(0.75, abs=0.05)
    assert checks.weight_of_moving_ahead(forecast, 2.0, 3.0, 1.0) == pytest.approx(0.75)
    assert checks.weight_ahead(forecast) == pytest.approx(0.3)
    assert checks.share_within(forecast, -1.0) == pytest.approx(0.1, abs=0.03)
    assert checks.share_sideways(forecast, 3.0) == 0
    assert math.isnan(checks.share_of_moving_ahead(_forecast(stands), 2.0, 3.0, 1.0))


def test_turns_are_told_by_the_last_second() -> None:
    path, _ = scenes.left_arc(np.array([10.0, 0.0]), 12.0, -10.0, math.pi / 2)(6.0 * AHEAD)
    forecast = _forecast(
        path, path * (1, -1), _straight(6.0), np.zeros((12, 2)), weights=[0.1, 0.2, 0.3, 0.4]
    )
    assert checks.weight_turning(forecast, 0.5) == pytest.approx((0.1, 0.2))
    assert checks.share_turning(forecast, 0.5) == pytest.approx((0.1, 0.2), abs=0.03)
    assert checks.weight_turning(forecast, 0.5, turned=0.6) == pytest.approx((0.4, 0.2))


def test_who_drives_into_a_lead_and_who_goes_round_it() -> None:
    lead = Frame(np.array([20.0, 0.0]), 0.0)
    round_it = np.stack([8.0 * AHEAD, 3.0 * np.exp(-(((8.0 * AHEAD - 20.0) / 8) ** 2))], axis=-1)
    stops = np.minimum(_straight(8.0), 14.0)
    forecast = _forecast(_straight(8.0), round_it, stops, weights=[0.5, 0.3, 0.2])
    assert checks.share_entering(forecast, lead) == pytest.approx(0.5, abs=0.04)
    close = _forecast(np.stack([8.0 * AHEAD, np.full(12, 1.5)], axis=-1))
    assert checks.share_entering(close, lead) == 0
    assert checks.share_entering(close, lead, checks.CAR_HALF_WIDTH) == 1


def test_widths_are_those_of_modes_that_move() -> None:
    forecast = _forecast(np.zeros((12, 2)), _straight(5.0), sigma=0.2)
    forecast.covariances[0] *= 1e-4
    assert checks.narrow_sigma(forecast, 1.0) == pytest.approx(0.2)
    assert math.isnan(checks.narrow_sigma(_forecast(np.zeros((12, 2))), 1.0))


def test_modes_side_by_side_merge() -> None:
    modes = [_straight(5.0, 0.01 * n) for n in range(9)] + [_straight(5.0, 1.5)]
    forecast = _forecast(*modes)
    assert checks.modes_for(forecast.weights, 0.9) == 9
    assert checks.merged_modes_for(forecast, 0.9) == 1
    assert checks.merged_modes_for(forecast, 0.95) == 2


def test_modes_are_matched_by_their_ids() -> None:
    one = _forecast(_straight(5.0), _straight(3.0))
    other = replace(one, mode_ids=one.mode_ids[::-1], means=one.means[::-1] + 0.3)
    assert checks.apart(one, other) == pytest.approx(0.3 * math.sqrt(2))
    with pytest.raises(ValueError, match="cannot be matched"):
        checks.apart(one, _forecast(_straight(5.0)))


def test_who_drives_as_forecast_does_not_jump() -> None:
    starts = 0.7 * np.arange(20)[:, None, None] * np.array([1.0, 0.0])
    paths = starts + _straight(7.0)
    np.testing.assert_allclose(checks.jumps(paths, 0.1), 0.0, atol=1e-9)
    paths[10:, :, 1] += 2.0
    assert checks.jumps(paths, 0.1).max() == pytest.approx(2.0)


def test_constant_velocity_meets_what_it_must() -> None:
    """It ignores roads and noise, but rotates with the scene and is right on straight roads without noise."""
    with Served(next(one for one in baselines() if one.info.name == "constant-velocity-yaw")) as served:
        straight = [one for one in SCENARIOS.values() if one.row in (Row.STRAIGHT, Row.HIGHWAY, Row.CREEPING)]
        clean = [one.case() for one in scenes.at_poses(straight) if not one.facts.noisy]
        assert len(clean) >= 8
        for case, forecast in zip(clean, served.answer(clean), strict=True):
            assert all(one.ok for one in readings(case, forecast)), case.name
        curve = SCENARIOS["curve 62"]
        case = curve.case()
        found = served.answer([curve.at(Pose(50.0, -30.0, angle)).case() for angle in (0.0, 1.0, 2.0, -3.0)])
        assert max(checks.apart(found[0], other) for other in found[1:]) < 0.01
        assert not all(one.ok for one in readings(case, found[0]))
