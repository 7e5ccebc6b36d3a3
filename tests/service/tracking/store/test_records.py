"""Binary records: packing and unpacking."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from model.mixture import TrajectoryMixture
from model.scenes.observations import Observations
from service.tracking.store.records import (
    BLOCK,
    FORECAST_BYTES,
    INSTANT,
    MODES,
    OBSERVATION_BYTES,
    pack_forecasts,
    pack_observations,
    unpack_observations,
)


def observations(counts: list[int]) -> Observations:
    """Return random observations, some with missing values."""
    rng = np.random.default_rng(sum(counts))
    shape = len(counts), max(counts)
    time = np.sort(rng.uniform(0, 100, shape), axis=1)
    padding = np.arange(shape[1]) >= np.array(counts)[:, None]
    time[padding] = np.inf

    def some(*more: int) -> np.ndarray:
        values = rng.normal(size=(*shape, *more))
        values[rng.random(shape) < 0.3] = np.nan
        values[padding] = np.nan
        return values

    position = rng.normal(size=(*shape, 2))
    position[padding] = np.nan
    return Observations(np.array(counts), time, position, some(), some(2), some(2), some())


@given(st.lists(st.integers(1, 7), min_size=1, max_size=5))
def test_observations_come_back(counts: list[int]) -> None:
    given_ones = observations(counts)
    packed = pack_observations(given_ones, newest_only=False)
    assert [len(each) for each in packed] == [count * OBSERVATION_BYTES for count in counts]
    back = unpack_observations(packed)
    for name in ("count", "time", "position", "heading", "velocity", "acceleration", "heading_rate"):
        np.testing.assert_array_equal(getattr(back, name), getattr(given_ones, name))


@given(st.lists(st.integers(1, 7), min_size=1, max_size=5))
def test_the_newest_is_the_last_one(counts: list[int]) -> None:
    whole = pack_observations(observations(counts), newest_only=False)
    newest = pack_observations(observations(counts), newest_only=True)
    assert newest == [each[-OBSERVATION_BYTES:] for each in whole]


@pytest.mark.parametrize(("modes", "steps"), [(25, 12), (1, 12), (3, 12), (25, 4)])
def test_a_forecast_holds_its_likeliest_modes(modes: int, steps: int) -> None:
    torch.manual_seed(0)
    mixture = TrajectoryMixture(
        torch.log_softmax(torch.randn(3, modes), 1),
        torch.randn(3, modes, steps, 2) * 30,
        torch.eye(2).expand(3, modes, steps, 2, 2),
        torch.randn(3, 2, dtype=torch.float64) * 1e5,
    )
    packed = pack_forecasts(mixture)
    assert [len(each) for each in packed] == [FORECAST_BYTES] * 3
    path = mixture.most_likely_trajectory().numpy()
    order = mixture.log_weights.argsort(dim=1, descending=True)
    for agent, each in enumerate(packed):
        blocks = np.frombuffer(each, dtype=BLOCK)
        np.testing.assert_array_equal(blocks["point"][0], mixture.origin[agent])
        np.testing.assert_array_equal(blocks["point"][1 : steps + 1], path[agent])
        assert np.isnan(blocks["point"][steps + 1 :]).all()
        for other in range(min(modes, MODES) - 1):
            mode = mixture.world_means[agent, order[agent, other + 1]].numpy()
            at = blocks["point"][1 : steps + 1] + blocks["others"][1 : steps + 1, other]
            np.testing.assert_allclose(at, mode, rtol=0, atol=1e-4)
        assert np.isnan(blocks["others"][:, min(modes, MODES) - 1 :]).all()


def test_sizes_are_those_that_are_stated() -> None:
    assert (OBSERVATION_BYTES, FORECAST_BYTES, INSTANT.itemsize) == (72, 672, 1856)
