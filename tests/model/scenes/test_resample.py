"""Resampling onto the 0.5 s grid."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.arrays import Floats
from model.geometry import wrap_angle
from model.scenes.observations import Observations
from model.scenes.resample import TIME_TOLERANCE, resample
from model.scenes.scene import STEP_SECONDS, AgentStates
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
    times = NOW - np.array([0.9, 0.1, 0.0])
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
    np.testing.assert_allclose(states.acceleration[0, -1], (-4.0, 0.0), atol=0.1)


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


# Denser than the grid: states are fitted

FIELDS = ("position", "velocity", "acceleration", "heading", "heading_rate")


def grid(frames: int = 5, now: float = NOW) -> Floats:
    return now - STEP_SECONDS * np.arange(frames - 1, -1, -1, dtype=np.float64)


def assert_same(a: AgentStates, b: AgentStates) -> None:
    for name in (*FIELDS, "first", "velocity_known"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def arc(speed: float, across: float) -> tuple[Path, Path]:
    """Position and heading on an arc that is driven with an acceleration across, m/s²; heading 0 now."""
    rate = across / speed

    def position(t: Floats) -> Floats:
        turned = rate * (t - NOW)
        return speed / rate * np.stack([np.sin(turned), 1 - np.cos(turned)], axis=1)

    return position, lambda t: rate * (t - NOW)


def noisy(path: Path, sigma: float, rng: np.random.Generator) -> Path:
    def values(t: Floats) -> Floats:
        exact = path(t)
        return exact + rng.normal(0, sigma, exact.shape)

    return values


@settings(deadline=None)
@given(
    hertz=st.sampled_from([5.0, 8.0, 10.0, 14.0, 20.0, 33.0]),
    velocity=st.tuples(st.floats(-30, 30), st.floats(-30, 30)),
    acceleration=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    offset=st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5)),
)
def test_dense_constant_acceleration_comes_out(
    hertz: float,
    velocity: tuple[float, float],
    acceleration: tuple[float, float],
    offset: tuple[float, float],
) -> None:
    v, a = np.array(velocity), np.array(acceleration)

    def path(t: Floats) -> Floats:
        ago = (t - NOW)[:, None]
        return np.array(offset) + v * ago + a * ago**2 / 2

    states = resample(one(at_rate(hertz, 4), path), NOW, 5)
    times = grid()
    assert states.first[0] == 0
    np.testing.assert_allclose(states.position[0], path(times), rtol=0, atol=0.03)
    np.testing.assert_allclose(states.velocity[0], v + a * (times - NOW)[:, None], rtol=0, atol=0.1)
    np.testing.assert_allclose(states.acceleration[0], np.broadcast_to(a, (5, 2)), rtol=0, atol=0.3)


@pytest.mark.parametrize("hertz", [5, 10, 20])
@pytest.mark.parametrize("speed", [5.0, 10.0, 20.0, 30.0])
@pytest.mark.parametrize("across", [-3.0, 1.0, 4.0])
@pytest.mark.parametrize("given_heading", [True, False])
def test_dense_arcs_come_out(hertz: float, speed: float, across: float, given_heading: bool) -> None:
    path, heading = arc(speed, across)
    obs = one(at_rate(hertz, 4), path, **({"heading": heading} if given_heading else {}))
    states = resample(obs, NOW, 5)
    times = grid()
    np.testing.assert_allclose(states.position[0], path(times), rtol=0, atol=0.05)
    direction = np.stack([np.cos(heading(times)), np.sin(heading(times))], axis=1)
    np.testing.assert_allclose(states.velocity[0], speed * direction, rtol=0, atol=0.2)
    off = wrap_angle(states.heading[0] - heading(times))
    np.testing.assert_allclose(off, 0, atol=0.02 if given_heading else 0.05)


@pytest.mark.parametrize("since", [0.5, 1.0, 2.0])
def test_a_start_from_rest_comes_out(since: float) -> None:
    def path(t: Floats) -> Floats:
        driven = np.maximum(t - NOW + since, 0.0)
        return np.stack([np.zeros_like(t), driven**2], axis=1)  # 2 m/s²

    states = resample(one(at_rate(10, 4), path), NOW, 5)
    times = grid()
    np.testing.assert_allclose(states.position[0], path(times), rtol=0, atol=0.05)
    np.testing.assert_allclose(
        states.velocity[0, :, 1], 2 * np.maximum(times - NOW + since, 0.0), rtol=0, atol=0.27
    )
    np.testing.assert_allclose(states.velocity[0, -1, 1], 2 * since, rtol=0, atol=0.2)
    np.testing.assert_allclose(states.heading[0, -1], np.pi / 2, atol=1e-6)


@settings(deadline=None)
@given(
    age=st.floats(0, 0.5),
    lost=st.lists(st.integers(0, 11), max_size=3),
    seed=st.integers(0, 2**32 - 1),
    derivatives=st.booleans(),
)
def test_two_hertz_at_any_age_is_not_fitted(
    age: float, lost: list[int], seed: int, derivatives: bool
) -> None:
    """Observations at 2 Hz stay as they were given, on the grid that ends with the newest one."""
    rng = np.random.default_rng(seed)
    times = np.delete(at_rate(2, 6, NOW - age), lost)
    fields: dict[str, Path] = {"heading": lambda t: rng.normal(0, 0.3, len(t))}
    if derivatives:
        fields["velocity"] = lambda t: rng.normal(0, 9, (len(t), 2))
        fields["acceleration"] = lambda t: rng.normal(0, 3, (len(t), 2))
        fields["heading_rate"] = lambda t: rng.normal(0, 1, len(t))
    obs = one(times, lambda t: rng.normal(0, 0.3, (len(t), 2)), **fields)
    now = resample(obs, NOW, 5)
    then = resample(obs, NOW - age, 5)
    np.testing.assert_array_equal(then.position[0, -1], obs.position[0, -1])
    np.testing.assert_array_equal(wrap_angle(obs.heading[0, -1:]), then.heading[0, -1:])
    for name in ("velocity", "acceleration", "heading_rate"):
        if derivatives:
            np.testing.assert_array_equal(getattr(then, name)[0, -1], getattr(obs, name)[0, -1])
        # A few microseconds of age count as none for some of the observations
        np.testing.assert_allclose(
            getattr(now, name)[0, -1],
            getattr(then, name)[0, -1],
            rtol=0,
            atol=0 if derivatives or age > 1e-3 or not age else 1e-3,
        )
    np.testing.assert_allclose(
        now.position[0, -1], obs.position[0, -1] + age * then.velocity[0, -1], rtol=0, atol=1e-3
    )


@pytest.mark.parametrize("hertz", [5, 10, 20])
@pytest.mark.parametrize("speed", [0.0, 0.5, 12.0, 33.0])
def test_noise_is_averaged(hertz: float, speed: float) -> None:
    """5 cm and 0.05 rad of noise on steady motion, against what single observations tell."""
    rng = np.random.default_rng(0)
    path = noisy(straight((0.0, speed)), 0.05, rng)
    tracks = [
        track(at_rate(hertz, 4), path, heading=noisy(lambda t: np.full_like(t, np.pi / 2), 0.05, rng))
        for _ in range(200)
    ]
    obs = observations(tracks)
    states = resample(obs, NOW, 5)

    def rms(values: Floats) -> float:
        return float(np.sqrt((values**2).mean()))

    assert rms(states.position[:, -1]) < (0.9 if hertz == 5 else 0.8) * 0.05
    assert rms(states.position[:, 2] - straight((0.0, speed))(grid()[2:3])) < 0.6 * 0.05
    assert rms(states.velocity[:, 2] - np.array([0.0, speed])) < 0.6 * np.sqrt(2) * 0.05 / STEP_SECONDS
    assert rms(states.velocity[:, -1] - np.array([0.0, speed])) < 0.22
    assert rms(wrap_angle(states.heading[:, -1] - np.pi / 2)) < (0.8 if hertz == 5 else 0.7) * 0.05


def test_the_fitted_states_do_not_jump_from_tick_to_tick() -> None:
    """Straight on at 10 m/s and 10 Hz with 5 cm and 0.02 rad of noise, over 100 ticks."""
    rng = np.random.default_rng(1)
    path, times = straight((10.0, 0.0)), at_rate(10, 14)
    obs = one(times, noisy(path, 0.05, rng), heading=noisy(np.zeros_like, 0.02, rng))
    ticks = times[-100:]
    states = [resample(obs, tick, 5) for tick in ticks.tolist()]
    position = np.array([s.position[0, -1] for s in states]) - path(ticks)
    heading = np.array([s.heading[0, -1] for s in states])
    velocity = np.array([s.velocity[0, -1] for s in states])
    assert np.abs(np.diff(position, axis=0)).max() < 0.15
    assert np.abs(np.diff(velocity, axis=0)).max() < 0.75
    assert np.abs(np.diff(heading)).max() < 0.03
    assert np.abs(heading).max() < 0.04


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.001, 0.3))
def test_states_change_steadily_while_nothing_new_is_seen(seed: int, start: float) -> None:
    """A millisecond moves the window by a millisecond: nothing leaves it with a step."""
    rng = np.random.default_rng(seed)
    obs = one(
        np.sort(NOW - rng.uniform(0, 4, 60)),
        noisy(straight((8.0, 3.0)), 0.3, rng),
        heading=noisy(lambda t: np.full_like(t, 0.36), 0.1, rng),
    )
    newest = float(obs.time[0, -1])
    a, b = resample(obs, newest + start, 4), resample(obs, newest + start + 1e-3, 4)
    moved = np.array([8.0, 3.0]) * 1e-3
    np.testing.assert_allclose(b.position[0] - a.position[0], np.tile(moved, (4, 1)), rtol=0, atol=0.02)
    np.testing.assert_allclose(b.velocity[0], a.velocity[0], rtol=0, atol=0.1)
    np.testing.assert_allclose(b.heading[0], a.heading[0], rtol=0, atol=0.02)


@settings(deadline=None)
@given(
    st.floats(-np.pi, np.pi), st.tuples(st.floats(-1e4, 1e4), st.floats(-1e4, 1e4)), st.integers(-1000, 1000)
)
def test_dense_states_do_not_depend_on_frame_and_clock(
    angle: float, offset: tuple[float, float], later: int
) -> None:
    rng = np.random.default_rng(3)
    path, heading = arc(9.0, 2.0)
    fields = {
        "heading": noisy(heading, 0.1, rng)(at_rate(10, 3)),
        "velocity": noisy(path, 0.2, rng)(at_rate(10, 3)),
    }
    position = noisy(path, 0.05, rng)(at_rate(10, 3))
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    a = resample(observations([{"time": at_rate(10, 3), "position": position, **fields}]), NOW, 5)
    moved = {
        "time": at_rate(10, 3, NOW + later),
        "position": position @ turn.T + np.array(offset),
        "heading": fields["heading"] + angle,
        "velocity": fields["velocity"] @ turn.T,
    }
    b = resample(observations([moved]), NOW + later, 5)
    np.testing.assert_allclose(b.position[0], a.position[0] @ turn.T + np.array(offset), rtol=0, atol=1e-6)
    np.testing.assert_allclose(b.velocity[0], a.velocity[0] @ turn.T, rtol=0, atol=1e-6)
    np.testing.assert_allclose(b.acceleration[0], a.acceleration[0] @ turn.T, rtol=0, atol=1e-5)
    np.testing.assert_allclose(wrap_angle(b.heading[0] - a.heading[0] - angle), 0, atol=1e-6)
    np.testing.assert_allclose(b.heading_rate[0], a.heading_rate[0], rtol=0, atol=1e-6)


@settings(deadline=None)
@given(st.floats(0, 0.4), st.integers(1, 5), st.floats(2e-4, 0.1))
def test_the_dense_future_changes_nothing(age: float, future: int, gap: float) -> None:
    times = at_rate(10, 2, NOW - age)
    later = np.concatenate([times, NOW + gap * np.arange(1, future + 1)])
    path = circle(15, 0.6)
    assert_same(resample(one(times, path), NOW, 5), resample(one(later, path), NOW, 5))
    nothing_yet = resample(one(np.array([NOW + gap, NOW + 2 * gap]), path), NOW, 5)
    assert nothing_yet.first[0] == 5


@pytest.mark.parametrize("hertz", [2, 4, 5, 10, 20])
@pytest.mark.parametrize("ago", [0, 1, 2, 5])
@pytest.mark.parametrize("speed", [3.0, 10.0])
@pytest.mark.parametrize("angle", [np.pi, 2.0])
def test_one_flipped_heading_does_not_steer(hertz: float, ago: int, speed: float, angle: float) -> None:
    heading = np.full(round(4 * hertz) + 1, 0.6)
    heading[-1 - ago] += angle
    path = straight((speed * np.cos(0.6), speed * np.sin(0.6)))
    states = resample(one(at_rate(hertz, 4), path, heading=lambda t: heading), NOW, 5)
    np.testing.assert_allclose(states.heading[0], 0.6, atol=0.02)
    np.testing.assert_allclose(states.heading_rate[0], 0.0, atol=0.05)


def test_a_flip_of_a_standing_agent_is_outvoted_where_it_is_seen_often() -> None:
    heading = np.zeros(41)
    heading[-1] = np.pi
    obs = one(at_rate(10, 4), straight((0.0, 0.0)), heading=lambda t: heading)
    np.testing.assert_allclose(resample(obs, NOW, 5).heading[0], 0.0, atol=1e-6)


@pytest.mark.parametrize("hertz", [2, 4, 10])
@pytest.mark.parametrize("speed", [0.6, 2.5, 5.0])
def test_reversing_agents_keep_their_headings(hertz: float, speed: float) -> None:
    obs = one(at_rate(hertz, 4), straight((-speed, 0.0)), heading=np.zeros_like)
    states = resample(obs, NOW, 5)
    np.testing.assert_allclose(states.heading[0], 0.0, atol=1e-6)
    np.testing.assert_allclose(states.velocity[0, -1], (-speed, 0.0), atol=1e-6)


def test_nobody_reverses_at_ten_meters_a_second() -> None:
    obs = one(at_rate(10, 4), straight((10.0, 0.0)), heading=lambda t: np.full_like(t, np.pi))
    np.testing.assert_allclose(resample(obs, NOW, 5).heading[0], 0.0, atol=1e-6)


def test_course_over_ground_outvotes_noisy_headings_of_fast_agents() -> None:
    rng = np.random.default_rng(5)
    tracks = [
        track(at_rate(10, 4), straight((10.0, 0.0)), heading=noisy(np.zeros_like, 0.1, rng))
        for _ in range(100)
    ]
    heading = resample(observations(tracks), NOW, 5).heading
    assert np.sqrt((heading**2).mean()) < 0.03
    standing = [t | {"position": np.zeros_like(t["position"])} for t in tracks]
    assert np.sqrt((resample(observations(standing), NOW, 5).heading ** 2).mean()) < 0.06


def test_slipping_sideways_is_measured_and_does_not_steer() -> None:
    obs = one(at_rate(10, 4), straight((0.0, 0.02)), heading=np.zeros_like)
    states = resample(obs, NOW, 5)
    np.testing.assert_allclose(states.heading[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(states.velocity[0], np.tile([0.0, 0.02], (5, 1)), atol=1e-6)


def test_without_headings_a_stopped_agent_keeps_the_direction_it_came_in() -> None:
    rng = np.random.default_rng(2)

    def path(t: Floats) -> Floats:
        return np.stack([np.zeros_like(t), np.minimum(t - NOW + 1.5, 0) * 4], axis=1)

    states = resample(one(at_rate(10, 4), noisy(path, 0.02, rng)), NOW, 5)
    np.testing.assert_allclose(states.heading[0], np.pi / 2, atol=0.15)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("given_velocity", [True, False])
def test_short_dense_histories(count: int, given_velocity: bool) -> None:
    fields: dict[str, Path] = {"heading": np.zeros_like}
    if given_velocity:
        fields["velocity"] = lambda t: np.tile([7.0, 0.0], (len(t), 1))
    states = resample(one(at_rate(10, (count - 1) / 10), straight((7.0, 0.0)), **fields), NOW, 5)
    assert states.first[0] == 4
    assert states.velocity_known[0] == (count > 1 or given_velocity)
    if states.velocity_known[0]:
        np.testing.assert_allclose(states.velocity[0, -1], (7.0, 0.0), atol=1e-5)
    np.testing.assert_allclose(states.position[0, -1], 0.0, atol=1e-6)
    np.testing.assert_allclose(states.heading[0, -1], 0.0, atol=1e-9)


def test_dense_given_velocities_are_evidence() -> None:
    """The positions' noise does not get into the velocities of a tracker that knows them better."""
    rng = np.random.default_rng(7)
    tracks = [
        track(
            at_rate(10, 4),
            noisy(straight((10.0, 0.0)), 0.1, rng),
            velocity=noisy(lambda t: np.tile([10.0, 0.0], (len(t), 1)), 0.2, rng),
        )
        for _ in range(100)
    ]
    velocity = resample(observations(tracks), NOW, 5).velocity[:, -1]
    assert np.sqrt(((velocity - np.array([10.0, 0.0])) ** 2).mean()) < 0.14
