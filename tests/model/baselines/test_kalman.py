import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from model.arrays import Floats
from model.baselines.kalman import HISTORY_FRAMES, NOISE, Kalman, Noise
from model.forecaster import join
from model.scenes.scene import AgentType
from tests.model.made_scenes import present, tracks

KALMAN = Kalman()
NOW = np.zeros(1, dtype=np.int64)
TIMES = 0.5 * np.arange(1, 13)


def _textbook(path: Floats, noise: Noise) -> tuple[Floats, Floats]:
    """Means [12, 2] and variances [12] of the filter in matrices, one step at a time."""
    dt, density, r = 0.5, noise.acceleration_density, noise.measurement**2
    f = np.array([[1, dt], [0, 1]])
    q = density * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    state = np.stack([path[0], np.zeros(2)])  # [position, velocity] × axes
    p = np.diag([r, 1e5])  # nothing is known of the velocity
    for measured in path[1:]:
        state, p = f @ state, f @ p @ f.T + q
        gain = p[:, 0] / (p[0, 0] + r)
        state = state + np.outer(gain, measured - state[0])
        p = p - np.outer(gain, p[0])
    means, variances = [], []
    for _ in TIMES:
        state, p = f @ state, f @ p @ f.T + q
        means.append(state[0])
        variances.append(p[0, 0])
    return np.array(means), np.array(variances)


@pytest.mark.parametrize("frames", [2, 3, 4, 5])
@pytest.mark.parametrize("kind", [AgentType.VEHICLE, AgentType.PEDESTRIAN])
def test_it_is_the_textbooks_filter(frames: int, kind: AgentType) -> None:
    path = np.cumsum(np.random.default_rng(frames).normal(1, 0.4, (frames, 2)), axis=0)
    mixture = KALMAN(tracks([path], HISTORY_FRAMES, kind), NOW)
    means, variances = _textbook(path, NOISE[kind])
    np.testing.assert_allclose(mixture.world_means[0, 0], means, atol=1e-3)
    expected = variances[:, None, None] * np.eye(2)
    np.testing.assert_allclose(mixture.covariances[0, 0], expected, rtol=1e-3, atol=1e-5)


def test_constant_velocity_is_continued_exactly() -> None:
    path = np.array([7.0, -3.0]) + np.arange(5)[:, None] * np.array([2.0, 0.5])
    means = KALMAN(tracks([path], 5), NOW).world_means[0, 0].numpy()
    np.testing.assert_allclose(means, path[-1] + TIMES[:, None] * np.array([4.0, 1.0]), atol=1e-5)


def test_noise_is_smoothed() -> None:
    rng = np.random.default_rng(0)
    noise = NOISE[AgentType.PEDESTRIAN].measurement
    paths = np.arange(5)[None, :, None] * 0.5 + rng.normal(0, 5 * noise, (400, 5, 2))
    scene = tracks(list(paths), 5, AgentType.PEDESTRIAN)
    ends = KALMAN(scene, np.arange(400)).world_means[:, 0, -1].numpy()
    naive = paths[:, -1] + 12 * (paths[:, -1] - paths[:, -2])
    truth = 0.5 * 16
    assert np.abs(ends - truth).mean() < 0.8 * np.abs(naive - truth).mean()


def test_one_frame_goes_on_at_the_velocity_it_came_with() -> None:
    mixture = KALMAN(present(position=(5.0, 5.0), velocity=(2.0, -1.0)), NOW)
    expected = np.array([5.0, 5.0]) + TIMES[:, None] * np.array([2.0, -1.0])
    np.testing.assert_allclose(mixture.world_means[0, 0], expected, atol=1e-5)
    standing = KALMAN(present(position=(5.0, 5.0), velocity=(np.nan, np.nan)), NOW)
    assert not standing.means.any()
    assert standing.covariances.isfinite().all()


def test_one_frame_of_many() -> None:
    alone = KALMAN(tracks([[(3.0, 4.0)]], 5), NOW)
    assert alone.means.isfinite().all()
    assert not alone.means.any()


def test_older_frames_than_five_are_not_looked_at() -> None:
    path = np.cumsum(np.random.default_rng(1).normal(1, 0.3, (9, 2)), axis=0)
    long, short = KALMAN(tracks([path], 9), NOW), KALMAN(tracks([path[-5:]], 5), NOW)
    torch.testing.assert_close(long.world_means, short.world_means)


def test_scenes_with_histories_of_different_length_are_joined() -> None:
    paths: list[ArrayLike] = [np.arange(2 * n).reshape(n, 2) * 0.4 for n in (1, 2, 3, 5, 7)]
    scenes = [tracks([path], len(np.asarray(path))) for path in paths]
    joint = KALMAN.forecast(join([KALMAN.prepare(scene, NOW) for scene in scenes]), AgentType.VEHICLE)
    for n, scene in enumerate(scenes):
        alone = KALMAN(scene, NOW)
        torch.testing.assert_close(joint.world_means[n], alone.world_means[0])
        torch.testing.assert_close(joint.covariances[n], alone.covariances[0])


def test_a_parked_car_mostly_stays() -> None:
    still = np.zeros((5, 2))
    deviation = [
        KALMAN(tracks([still], 5), NOW).covariances[0, 0, step, 0, 0].sqrt().item() for step in (1, 11)
    ]
    assert 0.05 < deviation[0] < 0.2
    assert 0.7 < deviation[1] < 1.2
    cyclist = KALMAN(tracks([still], 5, AgentType.CYCLIST), NOW).covariances[0, 0, 11, 0, 0].sqrt().item()
    moving = (
        KALMAN(tracks([np.arange(10).reshape(5, 2) * 2.0], 5), NOW).covariances[0, 0, 11, 0, 0].sqrt().item()
    )
    assert cyclist == pytest.approx(moving)
    assert 8 < moving < 11
    # Who has just stopped does not stand yet: the filter goes on believing in much acceleration
    stopped = np.array([[-6.0, 0], [-3, 0], [-1, 0], [0, 0], [0, 0]])
    assert KALMAN(tracks([stopped], 5), NOW).covariances[0, 0, 11, 0, 0].sqrt().item() > 8


def test_more_history_means_less_uncertainty() -> None:
    path = np.arange(10).reshape(5, 2) * 0.5
    ends = [KALMAN(tracks([path[-n:]], 5), NOW).covariances[0, 0, -1, 0, 0].item() for n in (2, 3, 4, 5)]
    assert ends == sorted(ends, reverse=True)


@settings(max_examples=60, deadline=None)
@given(
    x=st.floats(-1e7, 1e7),
    jumps=st.lists(st.tuples(st.floats(-75, 75), st.floats(-75, 75)), min_size=1, max_size=5),
    kind=st.sampled_from(AgentType),
)
def test_extreme_agents_get_finite_forecasts(
    x: float, jumps: list[tuple[float, float]], kind: AgentType
) -> None:
    mixture = KALMAN(tracks([np.array([x, -x]) + np.cumsum(jumps, axis=0)], 5, kind), NOW)
    assert mixture.means.isfinite().all()
    covariances = mixture.covariances.double()
    assert torch.equal(covariances, covariances.mT)
    assert (torch.linalg.eigvalsh(covariances) > 0).all()
    assert (torch.diff(covariances[0, 0, :, 0, 0]) > 0).all()


def test_far_from_the_origin_it_is_as_exact() -> None:
    path = np.cumsum(np.random.default_rng(2).normal(1, 0.3, (5, 2)), axis=0)
    here, there = KALMAN(tracks([path], 5), NOW), KALMAN(tracks([path + 1e6], 5), NOW)
    torch.testing.assert_close(there.world_means - 1e6, here.world_means, rtol=0, atol=1e-5)


def test_refusals() -> None:
    with pytest.raises(ValueError, match="steps"):
        KALMAN(present(), NOW, steps=13)
    with pytest.raises(ValueError, match="not observed now"):
        KALMAN.prepare(tracks([np.zeros((0, 2))], 3), NOW)


def test_what_it_says_of_itself() -> None:
    info = KALMAN.info
    assert (info.name, info.version, info.modes, info.history_frames) == ("kalman", "1.0.0", 1, 5)
    assert info.agent_types == tuple(AgentType)
    assert set(NOISE) == set(AgentType)
