"""Resampling onto the 0.5 s grid."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.arrays import Floats
from model.geometry import wrap_angle
from model.observations import Observations
from model.resample import TIME_TOLERANCE, resample
from model.scene import STEP_SECONDS
from tests.model.builders import Path, observations, track

NOW = 1_700_000_000.0  # seconds since the epoch: float64 has a quarter of a microsecond there


def straight(velocity: tuple[float, float], at: tuple[float, float] = (0.0, 0.0)) -> Path:
    return lambda t: np.asarray(at) + (t[:, None] - NOW) * np.asarray(velocity)


def circle(radius: float, rate: float) -> Path:
    return lambda t: radius * np.stack([np.cos(rate * (t - NOW)), np.sin(rate * (t - NOW))], axis=1)


def at_rate(hertz: float, seconds: float, newest: float = NOW) -> Floats:
    return newest - np.arange(round(seconds * hertz), -1, -1) / hertz


def one(times: Floats, path: Path, **fields: Path) -> Observations:
    return observations([track(times, path, **fields)])


def test_two_hertz_is_taken_as_it_is() -> None:
    times = at_rate(2, 2)
    obs = one(times, circle(20, 0.4))
    states = resample(obs, NOW, 5)
    np.testing.assert_array_equal(states.position[0], obs.position[0])
    assert states.first[0] == 0


def test_backward_differences() -> None:
    times = at_rate(2, 3)  # two frames more than are returned: every difference exists
    obs = one(times, circle(20, 0.4))
    states = resample(obs, NOW, 5)
    p = obs.position[0]
    velocity = np.diff(p, axis=0) / STEP_SECONDS
    np.testing.assert_allclose(states.velocity[0], velocity[1:], rtol=0, atol=1e-9)
    acceleration = np.diff(velocity, axis=0) / STEP_SECONDS
    np.testing.assert_allclose(states.acceleration[0], acceleration, rtol=0, atol=1e-9)
    np.testing.assert_allclose(states.heading[0], np.arctan2(velocity[1:, 1], velocity[1:, 0]))
    np.testing.assert_allclose(states.heading_rate[0], 0.4, atol=1e-9)


def test_the_oldest_frame_takes_what_it_cannot_difference_from_the_next() -> None:
    obs = one(at_rate(2, 2), circle(20, 0.4))
    states = resample(obs, NOW, 5)
    np.testing.assert_array_equal(states.velocity[0, 0], states.velocity[0, 1])
    np.testing.assert_array_equal(states.acceleration[0, 0], 0)
    np.testing.assert_array_equal(states.acceleration[0, 1], 0)
    assert states.heading_rate[0, 0] == states.heading_rate[0, 1]


def test_given_values_are_used_as_they_are() -> None:
    fields: dict[str, Path] = {
        "velocity": lambda t: np.stack([t - NOW + 7, np.full_like(t, -3.0)], axis=1),
        "acceleration": lambda t: np.stack([np.full_like(t, 1.5), t - NOW], axis=1),
        "heading": lambda t: 0.3 + 0.01 * (t - NOW),
        "heading_rate": lambda t: 0.2 + 0.1 * (t - NOW),
    }
    obs = one(at_rate(2, 2), straight((1, 1)), **fields)
    states = resample(obs, NOW, 5)
    np.testing.assert_array_equal(states.velocity[0], obs.velocity[0])
    np.testing.assert_array_equal(states.acceleration[0], obs.acceleration[0])
    np.testing.assert_allclose(states.heading[0], obs.heading[0], atol=1e-12)
    np.testing.assert_array_equal(states.heading_rate[0], obs.heading_rate[0])


def test_what_is_given_in_part_is_derived_in_part() -> None:
    obs = one(at_rate(2, 3), straight((4, 0)))
    obs.velocity[0, -1] = (9.0, 1.0)
    states = resample(obs, NOW, 5)
    np.testing.assert_array_equal(states.velocity[0, -1], (9.0, 1.0))
    np.testing.assert_allclose(states.velocity[0, -2], (4.0, 0.0), atol=1e-6)
    # A given velocity and a derived one are not differenced: the positions show no acceleration
    np.testing.assert_allclose(states.acceleration[0, -1], (0.0, 0.0), atol=1e-5)


@given(
    hertz=st.sampled_from([2.0, 4.0, 5.0, 7.0, 10.0, 20.0, 33.0]),
    age=st.floats(0, 0.45),
    velocity=st.tuples(st.floats(-40, 40), st.floats(-40, 40)),
    offset=st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5)),
)
def test_constant_velocity_at_any_rate_and_age_is_exact(
    hertz: float, age: float, velocity: tuple[float, float], offset: tuple[float, float]
) -> None:
    path = straight(velocity, offset)
    states = resample(one(at_rate(hertz, 4, NOW - age), path), NOW, 5)
    grid = NOW - STEP_SECONDS * np.arange(4, -1, -1, dtype=np.float64)
    assert states.first[0] == 0
    # An observation stands for a grid time that is no further away than the tolerance
    off = TIME_TOLERANCE * float(np.hypot(*velocity)) + 1e-4
    np.testing.assert_allclose(states.position[0], path(grid), rtol=0, atol=off)
    expected = np.broadcast_to(np.array(velocity), (5, 2))
    np.testing.assert_allclose(states.velocity[0], expected, rtol=0, atol=2 * off / STEP_SECONDS)


@given(st.floats(0, 10), st.integers(3, 40), st.integers(0, 2**32 - 1))
def test_the_future_changes_nothing(shift: float, count: int, seed: int) -> None:
    """Observations after the present, which the service refuses, would not leak in even so."""
    rng = np.random.default_rng(seed)
    times = NOW - np.sort(rng.uniform(0, 3, count))[::-1]
    times[-1] = NOW
    path = rng.normal(size=(count + 1, 2)).cumsum(axis=0)
    known = observations([{"time": times, "position": path[:-1]}])
    later = observations([{"time": np.append(times, NOW + 0.1 + shift), "position": path}])
    a, b = resample(known, NOW, 5), resample(later, NOW, 5)
    for name in ("position", "velocity", "acceleration", "heading", "heading_rate", "first"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_heading_is_interpolated_over_the_wrap() -> None:
    times = NOW - np.array([0.75, 0.25, 0.0])
    obs = observations(
        [{"time": times, "position": np.zeros((3, 2)), "heading": np.array([3.1, -3.1, -3.0])}]
    )
    states = resample(obs, NOW, 2)
    assert abs(abs(states.heading[0, 0]) - np.pi) < 1e-9
    assert abs(states.heading_rate[0, 1] - (np.pi - 3.0) / 0.5) < 1e-9


def test_headings_beyond_a_turn_are_wrapped() -> None:
    obs = one(at_rate(2, 2), straight((0, 0)), heading=lambda t: np.full_like(t, 1.0 + 8 * np.pi))
    np.testing.assert_allclose(resample(obs, NOW, 5).heading[0], 1.0)


def test_a_standing_agent_keeps_its_last_heading() -> None:
    times = at_rate(2, 3)
    obs = one(times, lambda t: np.stack([np.zeros_like(t), np.minimum(t - NOW + 1.5, 0) * 4], axis=1))
    states = resample(obs, NOW, 5)
    np.testing.assert_allclose(states.velocity[0, -1], 0, atol=1e-9)
    np.testing.assert_allclose(states.heading[0], np.pi / 2)


def test_a_heading_that_nothing_tells_is_nan() -> None:
    states = resample(one(at_rate(2, 2), straight((0, 0))), NOW, 5)
    assert np.isnan(states.heading[0]).all()
    assert np.isfinite(states.heading_rate[0]).all()


@pytest.mark.parametrize(("gap", "frames"), [(1.0, 5), (1.04, 5), (1.2, 2)])
def test_one_lost_frame_is_bridged_a_wider_gap_is_not(gap: float, frames: int) -> None:
    older = NOW - 0.5 - gap - np.arange(3, -1, -1, dtype=np.float64) * 0.5
    times = np.concatenate([older, np.array([NOW - 0.5, NOW])])
    states = resample(one(times, straight((3, 0))), NOW, 5)
    assert 5 - states.first[0] == frames
    assert np.isnan(states.position[0, : states.first[0]]).all()
    assert np.isfinite(states.position[0, states.first[0] :]).all()


@pytest.mark.parametrize(("age", "observed"), [(0.0, True), (0.49, True), (0.5, True), (0.6, False)])
def test_an_agent_not_seen_for_half_a_second_is_gone(age: float, observed: bool) -> None:
    states = resample(one(at_rate(10, 2, NOW - age), straight((3, 0))), NOW, 5)
    assert (states.first[0] < 5) == observed


def test_short_fast_history_tells_the_velocity() -> None:
    obs = one(at_rate(10, 0.3), straight((6, -2)))
    states = resample(obs, NOW, 5)
    assert states.first[0] == 4
    np.testing.assert_allclose(states.velocity[0, -1], (6, -2), atol=1e-5)
    assert states.velocity_known[0]


def test_a_single_position_tells_no_velocity() -> None:
    obs = one(np.array([NOW]), straight((6, -2)))
    states = resample(obs, NOW, 5)
    assert states.first[0] == 4
    assert not states.velocity_known[0]
    obs.velocity[0, 0] = (6, -2)
    assert resample(obs, NOW, 5).velocity_known[0]


def test_agents_do_not_touch_each_other() -> None:
    tracks = [
        track(at_rate(10, 2), circle(10, 0.5)),
        track(at_rate(2, 1), straight((5, 5))),
        track(at_rate(3, 6, NOW - 0.2), straight((-5, 1))),
        track(np.array([NOW - 9.0]), straight((1, 1))),
    ]
    together = resample(observations(tracks), NOW, 5)
    for n, alone in enumerate(resample(observations([t]), NOW, 5) for t in tracks):
        np.testing.assert_array_equal(together.position[n], alone.position[0])
        np.testing.assert_array_equal(together.acceleration[n], alone.acceleration[0])
        assert together.first[n] == alone.first[0]
    assert together.first[3] == 5


@given(st.floats(-np.pi, np.pi))
def test_turning_the_world_turns_the_states(angle: float) -> None:
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    obs = one(at_rate(10, 3), circle(15, 0.6))
    turned = observations([{"time": obs.time[0], "position": obs.position[0] @ turn.T}])
    a, b = resample(obs, NOW, 5), resample(turned, NOW, 5)
    np.testing.assert_allclose(a.velocity[0] @ turn.T, b.velocity[0], atol=1e-9)
    np.testing.assert_allclose(a.acceleration[0] @ turn.T, b.acceleration[0], atol=1e-8)
    difference = (b.heading[0] - a.heading[0] - angle + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(difference, 0, atol=1e-9)


def braking(t: Floats) -> Floats:
    """20 m/s now, braking at 4 m/s²."""
    ago = t - NOW
    return np.stack([20 * ago - 2 * ago**2, np.zeros_like(t)], axis=1)


@pytest.mark.parametrize("age", [0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
def test_braking_does_not_fade_with_the_age_of_the_newest_state(age: float) -> None:
    states = resample(one(at_rate(10, 4, NOW - age), braking), NOW, 5)
    np.testing.assert_allclose(states.acceleration[0, -1], (-4.0, 0.0), atol=1e-4)


def test_a_velocity_given_now_alone_makes_no_false_acceleration() -> None:
    obs = one(at_rate(2, 3), braking)
    obs.velocity[0, -1] = (20.0, 0.0)
    np.testing.assert_allclose(resample(obs, NOW, 5).acceleration[0, -1], (-4.0, 0.0), atol=1e-4)


def test_a_heading_given_now_alone_makes_no_false_turn() -> None:
    obs = one(at_rate(2, 3), straight((-3.0, 0.0)))
    obs.heading[0, -1] = 0.0  # it reverses
    states = resample(obs, NOW, 5)
    np.testing.assert_allclose(states.heading_rate[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.abs(wrap_angle(states.heading[0])), 0.0, atol=1e-6)


@pytest.mark.parametrize(
    "times",
    [
        [-1.5, -1.0, -0.48, -0.45],
        [-1.5, -1.0, -0.52, -0.02, 0.0],
        [-1.5, -1.0, -0.32, -0.30],
        [-0.05, 0.0],
        [-0.55, -0.3],
        [-1.05, 0.0],
    ],
)
@pytest.mark.parametrize("frames", [1, 5])
def test_close_and_stale_states_keep_the_velocity(times: list[float], frames: int) -> None:
    states = resample(one(NOW + np.array(times), straight((10.0, -4.0))), NOW, frames)
    assert states.velocity_known[0]
    observed = slice(int(states.first[0]), None)
    np.testing.assert_allclose(
        states.velocity[0, observed], np.broadcast_to([10.0, -4.0], (frames, 2))[observed], atol=2e-3
    )
    np.testing.assert_allclose(states.position[0, -1], (0.0, 0.0), atol=2e-3)


@given(st.lists(st.floats(0, 1), min_size=2, max_size=12), st.floats(0, 0.5), st.integers(1, 9))
def test_steady_motion_is_exact_or_said_to_be_unknown(gaps: list[float], age: float, frames: int) -> None:
    times = NOW - age - np.cumsum([0.0, *(g + 1e-3 for g in gaps)])[::-1]
    states = resample(one(times, straight((7.0, 3.0))), NOW, frames)
    if not states.velocity_known[0]:
        assert times[-1] - times[0] < 0.05
        return
    observed = slice(int(states.first[0]), None)
    np.testing.assert_allclose(states.velocity[0, observed][:, 0], 7.0, atol=0.02)
    np.testing.assert_allclose(states.acceleration[0, observed], 0.0, atol=0.04)
    np.testing.assert_allclose(states.position[0, -1], (0.0, 0.0), atol=0.01)


@pytest.mark.parametrize("age", [0.3, 0.5])
def test_a_single_old_position_tells_no_velocity(age: float) -> None:
    for frames in (1, 5):
        states = resample(one(np.array([NOW - age]), straight((7.0, 3.0))), NOW, frames)
        assert not states.velocity_known[0]
