import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from model.arrays import Floats
from model.baselines.physics import Physics, baselines
from model.baselines.uncertainty import Growth, Spread, SpreadBySpeed, aligned_covariance, ellipse_radius
from model.forecaster import Context, Protocol, agent_count, join
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentStates, AgentType, Scene
from tests.model.made_scenes import present

TIMES = 0.5 * np.arange(1, 13)
BY_NAME = {forecaster.info.name: forecaster for forecaster in baselines()}
NOW = np.zeros(1, dtype=np.int64)


def _path(name: str, scene: Scene, steps: int | None = None) -> Floats:
    """[T, 2], the one forecast, m, ground frame."""
    path: Floats = BY_NAME[name](scene, NOW, steps=steps).world_means[0, 0].numpy()
    return path


def _check_covariances(mixture: TrajectoryMixture) -> None:
    covariances = mixture.covariances
    assert covariances.isfinite().all()
    assert torch.equal(covariances, covariances.mT)
    eigenvalues = torch.linalg.eigvalsh(covariances.double())
    assert (eigenvalues > 0).all()
    growth = torch.diff(covariances.double().diagonal(dim1=-2, dim2=-1).sum(-1), dim=-1)
    assert (growth > 0).all()


def test_what_they_say_of_themselves() -> None:
    assert list(BY_NAME) == [
        "constant-velocity-yaw",
        "constant-speed-yaw-rate",
        "constant-acceleration-yaw",
        "constant-acceleration-yaw-rate",
    ]
    for forecaster in BY_NAME.values():
        info = forecaster.info
        assert (info.version, info.protocol, info.license) == ("1.0.0", Protocol.CAUSAL, "Apache-2.0")
        assert info.agent_types == tuple(AgentType)
        assert (info.modes, info.steps, info.supports_blind) == (1, 12, True)
        assert (info.context_types, info.uses_map, info.uses_neighbors) == ((), False, False)


@pytest.mark.parametrize("name", BY_NAME)
def test_straight_on_at_constant_speed(name: str) -> None:
    scene = present(position=(10.0, -5.0), velocity=(3.0, 4.0), heading=0.3)
    expected = np.array([10.0, -5.0]) + TIMES[:, None] * np.array([3.0, 4.0])
    np.testing.assert_allclose(_path(name, scene), expected, atol=1e-5)


def test_acceleration_counts_along_the_direction_of_travel() -> None:
    scene = present(velocity=(4.0, 0.0), acceleration=(1.5, 7.0), heading=0.0)
    expected = 4 * TIMES + 0.75 * TIMES**2
    path = _path("constant-acceleration-yaw", scene)
    np.testing.assert_allclose(path, np.stack([expected, 0 * TIMES], axis=-1), atol=1e-4)


@pytest.mark.parametrize("name", ["constant-acceleration-yaw", "constant-acceleration-yaw-rate"])
def test_who_brakes_stops_and_stays(name: str) -> None:
    # From 6 m/s at −2 m/s²: stands after 3 s and 9 m
    scene = present(velocity=(0.0, 6.0), acceleration=(0.0, -2.0), heading=np.pi / 2)
    path = _path(name, scene)
    np.testing.assert_allclose(path[5:], np.tile([0.0, 9.0], (7, 1)), atol=1e-5)
    assert path[4, 1] < 9


def test_a_turn_is_an_arc() -> None:
    rate, speed = 0.4, 8.0
    scene = present(velocity=(speed, 0.0), heading=0.0, heading_rate=rate)
    radius = speed / rate
    expected = radius * np.stack([np.sin(rate * TIMES), 1 - np.cos(rate * TIMES)], axis=-1)
    np.testing.assert_allclose(_path("constant-speed-yaw-rate", scene), expected, atol=1e-5)
    # and the others go straight on
    np.testing.assert_allclose(_path("constant-velocity-yaw", scene)[:, 1], 0, atol=1e-9)


@settings(max_examples=60, deadline=None)
@given(st.floats(0, 30), st.floats(-4, 4), st.floats(-8, 8), st.floats(-2, 2) | st.floats(-0.02, 0.02))
def test_the_exact_arc_is_the_limit_of_small_steps(
    speed: float, course: float, acceleration: float, rate: float
) -> None:
    along = np.array([np.cos(course), np.sin(course)])
    scene = present(
        velocity=speed * along, acceleration=acceleration * along, heading=course, heading_rate=rate
    )
    fine = 2000
    time = (np.arange(12 * fine) + 0.5) * 0.5 / fine  # midpoints
    speeds = np.maximum(speed + acceleration * time, 0)
    angles = course + rate * time
    rates = speeds[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    expected = np.cumsum(rates * 0.5 / fine, axis=0)[fine - 1 :: fine]
    path = _path("constant-acceleration-yaw-rate", scene)
    np.testing.assert_allclose(path, expected, rtol=1e-5, atol=1e-4)


def test_reversing_goes_on_backwards() -> None:
    scene = present(velocity=(-2.0, 0.0), heading=0.0, heading_rate=0.0)
    for name in BY_NAME:
        np.testing.assert_allclose(_path(name, scene)[:, 0], -2 * TIMES, atol=1e-5)


def test_who_stands_sets_off_along_the_heading() -> None:
    scene = present(acceleration=(0.0, 2.0), heading=np.pi / 2)
    np.testing.assert_allclose(_path("constant-acceleration-yaw", scene)[:, 1], TIMES**2, atol=1e-5)
    # and does not start to reverse
    scene = present(acceleration=(0.0, -2.0), heading=np.pi / 2)
    assert not _path("constant-acceleration-yaw", scene).any()


@pytest.mark.parametrize("name", BY_NAME)
def test_what_is_not_known_counts_as_zero(name: str) -> None:
    scene = present(
        position=(5.0, 5.0), velocity=(1.0, 1.0), acceleration=(np.nan, np.nan), heading_rate=np.nan
    )
    np.testing.assert_allclose(_path(name, scene)[-1], [11.0, 11.0], atol=1e-5)
    mixture = BY_NAME[name](present(velocity=(np.nan, np.nan)), NOW)
    assert not mixture.means.any()
    _check_covariances(mixture)


@pytest.mark.parametrize("name", BY_NAME)
@pytest.mark.parametrize("kind", AgentType)
@settings(max_examples=20, deadline=None)
@given(st.data())
def test_extreme_agents_get_finite_forecasts(name: str, kind: AgentType, data: st.DataObject) -> None:
    x = data.draw(st.floats(-1e7, 1e7))
    v = data.draw(st.tuples(st.floats(-150, 150), st.floats(-150, 150)))
    a = data.draw(st.tuples(st.floats(-100, 100), st.floats(-100, 100)))
    heading = data.draw(st.floats(-np.pi, np.pi) | st.just(np.nan))
    rate = data.draw(st.floats(-20, 20))
    scene = present(
        position=(x, -x), velocity=v, acceleration=a, heading=heading, heading_rate=rate, kind=kind
    )
    mixture = BY_NAME[name](scene, NOW)
    assert mixture.means.isfinite().all()
    assert mixture.world_means.dtype == torch.float64
    reach = np.hypot(*v) * TIMES + np.hypot(*a) * TIMES**2 / 2
    assert (mixture.means[0, 0].norm(dim=-1).numpy() <= reach * (1 + 1e-5) + 1e-5).all()
    _check_covariances(mixture)


@pytest.mark.parametrize("name", BY_NAME)
def test_moving_and_turning_the_world(name: str) -> None:
    angle, offset = 1.1, np.array([1e5, -2e5])
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    here = BY_NAME[name](
        present(velocity=(5.0, 1.0), acceleration=(-0.4, 0.3), heading=0.2, heading_rate=0.1), NOW
    )
    there = BY_NAME[name](
        present(
            position=offset,
            velocity=turn @ [5.0, 1.0],
            acceleration=turn @ [-0.4, 0.3],
            heading=0.2 + angle,
            heading_rate=0.1,
        ),
        NOW,
    )
    rotation = torch.tensor(turn)
    moved = there.world_means - torch.tensor(offset)
    torch.testing.assert_close(moved, here.world_means @ rotation.T, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(
        there.covariances.double(), rotation @ here.covariances.double() @ rotation.T, rtol=1e-5, atol=1e-5
    )


def _axis(mixture: TrajectoryMixture, step: int) -> Tensor:
    """[2], the ellipse's long axis, with the first number positive."""
    axis: Tensor = torch.linalg.eigh(mixture.covariances[0, 0, step].double()).eigenvectors[:, 1]
    return axis * axis[0].sign()


def test_the_ellipse_turns_with_the_path() -> None:
    mixture = BY_NAME["constant-speed-yaw-rate"](
        present(velocity=(8.0, 0.0), heading=0.0, heading_rate=0.2), NOW
    )
    for step in (0, 5, 11):
        angle = 0.2 * TIMES[step]
        np.testing.assert_allclose(_axis(mixture, step), [np.cos(angle), np.sin(angle)], atol=1e-5)


def test_the_ellipse_of_who_creeps_lies_along_the_heading() -> None:
    slow = present(velocity=(0.0, 0.2), heading=0.0)
    np.testing.assert_allclose(_axis(BY_NAME["constant-velocity-yaw"](slow, NOW), 3), [1, 0], atol=1e-6)
    unknown = present(velocity=(0.2, 0.2))
    expected = [np.sqrt(0.5), np.sqrt(0.5)]
    np.testing.assert_allclose(_axis(BY_NAME["constant-velocity-yaw"](unknown, NOW), 3), expected, atol=1e-6)


def test_growth_law() -> None:
    growth = Growth(position=0.3, velocity=0.4, acceleration=0.5)
    time = torch.tensor([0.0, 2.0], dtype=torch.float64)
    np.testing.assert_allclose(growth.variance(time), [0.09, 0.09 + 0.64 + 1.0])
    spread = SpreadBySpeed((0.0,), (Spread(along=growth, across=Growth(0.1, 0.0, 0.0)),))
    speed = torch.tensor([5.0], dtype=torch.float64)
    north = torch.tensor([[np.pi / 2]], dtype=torch.float64)
    covariance = aligned_covariance(spread, speed, time[1:], north)
    np.testing.assert_allclose(covariance[0, 0], [[0.01, 0], [0, 1.73]], atol=1e-9)


def test_growth_changes_linearly_with_the_speed() -> None:
    def both(value: float) -> Spread:
        return Spread(along=Growth(value, 0.0, 0.0), across=Growth(0.0, 2 * value, 0.0))

    spread = SpreadBySpeed((1.0, 3.0, 4.0), (both(1.0), both(2.0), both(6.0)))
    speed = torch.tensor([0.0, 1.0, 2.0, 3.0, 3.5, 4.0, 50.0], dtype=torch.float64)
    along, across = spread.variances(speed, torch.tensor([0.5, 1.0], dtype=torch.float64))
    expected = np.array([1.0, 1.0, 1.5, 2.0, 4.0, 6.0, 6.0])
    np.testing.assert_allclose(along.sqrt(), np.tile(expected[:, None], (1, 2)))
    np.testing.assert_allclose(across.sqrt(), expected[:, None] * [1.0, 2.0])


def _sigma(name: str, speed: float, kind: AgentType = AgentType.VEHICLE) -> tuple[float, float]:
    """σ along and across at 6 s, m, of who drives along x."""
    covariance = BY_NAME[name](present(velocity=(speed, 0.0), heading=0.0, kind=kind), NOW).covariances[
        0, 0, -1
    ]
    return float(covariance[0, 0].sqrt()), float(covariance[1, 1].sqrt())


@pytest.mark.parametrize("name", BY_NAME)
def test_a_standing_car_mostly_stays(name: str) -> None:
    along, across = _sigma(name, 0.0)
    assert 0.8 < along < 1.8
    assert 0.25 < across < 0.5
    # So does one whose velocity is a detector's noise
    along, across = _sigma(name, 0.05)
    assert along < 3
    assert across < 2.5


@pytest.mark.parametrize("name", BY_NAME)
def test_a_driving_car_may_do_much(name: str) -> None:
    for speed in (1.0, 3.0, 6.0, 12.0, 40.0):
        along, across = _sigma(name, speed)
        assert 10 < along < 50
        assert 4 < across < 12
    assert _sigma(name, 12.0) == _sigma(name, 40.0)


def test_only_the_widths_of_vehicles_depend_on_the_speed() -> None:
    for kind in (AgentType.PEDESTRIAN, AgentType.CYCLIST, AgentType.UNKNOWN):
        assert _sigma("constant-velocity-yaw", 0.0, kind) == _sigma("constant-velocity-yaw", 5.0, kind)


def test_ellipse_radius_holds_its_share() -> None:
    drawn = np.random.default_rng(0).standard_normal((100_000, 2))
    for share in (0.0, 0.5, 0.9):
        inside = (np.hypot(*drawn.T) <= ellipse_radius(share)).mean()
        assert inside == pytest.approx(share, abs=0.01)


def test_agents_of_many_scenes_share_a_forward() -> None:
    forecaster = BY_NAME["constant-acceleration-yaw-rate"]
    scenes = [present(position=(k, 2.0), velocity=(k, 1.0), heading_rate=0.1 * k) for k in range(4)]
    features = join([forecaster.prepare(scene, NOW, Context.BLIND) for scene in scenes])
    assert agent_count(features) == 4
    joint = forecaster.forecast(features, AgentType.VEHICLE, Context.BLIND, steps=7)
    assert joint.means.shape == (4, 1, 7, 2)
    assert joint.covariances.shape == (4, 1, 7, 2, 2)
    for k, scene in enumerate(scenes):
        torch.testing.assert_close(joint[k : k + 1].means, forecaster(scene, NOW, steps=7).means)


def test_only_the_targets_are_forecast_and_only_if_seen() -> None:
    nan = np.full((2, 1), np.nan)
    states = AgentStates(
        position=np.array([[[np.nan, np.nan]], [[1.0, 2.0]]]),
        velocity=np.array([[[np.nan, np.nan]], [[1.0, 0.0]]]),
        acceleration=np.stack([nan, nan], axis=-1),
        heading=nan,
        heading_rate=nan,
        first=np.array([1, 0]),
        velocity_known=np.array([False, True]),
    )
    scene = Scene([AgentType.VEHICLE, AgentType.CYCLIST], states)
    forecaster: Physics = BY_NAME["constant-velocity-yaw"]
    assert len(forecaster(scene, np.array([1]))) == 1
    with pytest.raises(ValueError, match=r"\[0\] are not observed now"):
        forecaster.prepare(scene, np.array([0, 1]))


@pytest.mark.parametrize("steps", [0, -1, 13])
def test_steps_out_of_range(steps: int) -> None:
    with pytest.raises(ValueError, match="steps must be in 1 … 12"):
        BY_NAME["constant-velocity-yaw"](present(), NOW, steps=steps)


def test_a_prefix_of_a_long_forecast_is_the_short_one() -> None:
    scene = present(velocity=(4.0, 1.0), heading_rate=0.2)
    for name in BY_NAME:
        np.testing.assert_allclose(_path(name, scene, 4), _path(name, scene)[:4])
