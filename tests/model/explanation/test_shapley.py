"""Shapley values against their definition, and their axioms."""

from itertools import permutations

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from model.arrays import Floats
from model.explanation.shapley import (
    antithetic_orders,
    coalitions,
    estimated_values,
    joined,
    shapley_values,
    standard_error,
)

GAMES = st.integers(0, 4).flatmap(
    lambda players: arrays(np.float64, (2**players, 2), elements=st.floats(-100, 100))
)


def by_definition(values: Floats) -> Floats:
    """Return the mean gain of each player over all orders."""
    players = len(values).bit_length() - 1
    total = np.zeros((players, values.shape[1]))
    orders = list(permutations(range(players)))
    for order in orders:
        coalition = 0
        for player in order:
            total[player] += values[coalition | 1 << player] - values[coalition]
            coalition |= 1 << player
    return total / len(orders)


@given(GAMES)
def test_values_are_those_of_the_definition_and_add_up(values: Floats) -> None:
    result = shapley_values(values)
    np.testing.assert_allclose(result, by_definition(values), atol=1e-9)
    np.testing.assert_allclose(result.sum(axis=0), values[-1] - values[0], atol=1e-9)


@given(GAMES, st.data())
def test_who_changes_nothing_gets_exactly_nothing(values: Floats, data: st.DataObject) -> None:
    players = len(values).bit_length() - 1
    if not players:
        return
    idle = data.draw(st.integers(0, players - 1))
    members = coalitions(players)
    without = np.flatnonzero(~members[:, idle])
    values[without + 2**idle] = values[without]
    assert not shapley_values(values)[idle].any()


def test_games_are_computed_together() -> None:
    values = np.random.default_rng(0).normal(size=(5, 2, 8, 3))
    np.testing.assert_allclose(shapley_values(values)[3, 1], shapley_values(values[3, 1]))


def test_coalitions_of_no_number_of_players_are_refused() -> None:
    with pytest.raises(ValueError, match="3 coalitions"):
        shapley_values(np.zeros((3, 1)))


def test_orders_come_with_their_reverse() -> None:
    orders = antithetic_orders(7, 10, np.random.default_rng(0))
    assert (np.sort(orders, axis=1) == np.arange(7)).all()
    np.testing.assert_array_equal(orders[1::2], orders[::2, ::-1])
    assert len({tuple(order) for order in orders[::2].tolist()}) == 5
    for count in (0, 3):
        with pytest.raises(ValueError, match="pairs of orders"):
            antithetic_orders(4, count, np.random.default_rng(0))


def test_an_order_passes_through_growing_coalitions() -> None:
    np.testing.assert_array_equal(
        joined(np.array([2, 0, 1])), np.array([[0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1]], dtype=bool)
    )


def played(values: Floats, orders: np.ndarray) -> Floats:
    """Return the values of the coalitions that orders pass through."""
    bits = 1 << np.arange(orders.shape[1])
    return np.array([values[joined(order) @ bits] for order in orders])


def test_estimates_are_exact_for_players_who_add_up() -> None:
    members = coalitions(5)
    values = members @ np.random.default_rng(0).normal(size=(5, 2)) + 7.0
    orders = antithetic_orders(5, 4, np.random.default_rng(1))
    estimates, errors = estimated_values(orders, played(values, orders))
    np.testing.assert_allclose(estimates, shapley_values(values), atol=1e-12)
    np.testing.assert_allclose(errors, 0, atol=1e-12)


def test_estimates_are_as_near_as_their_errors_say() -> None:
    random = np.random.default_rng(2)
    values = random.normal(size=(2**8, 1))
    exact = shapley_values(values)
    off = []
    for seed in range(40):
        orders = antithetic_orders(8, 32, np.random.default_rng(seed))
        estimates, errors = estimated_values(orders, played(values, orders))
        np.testing.assert_allclose(estimates.sum(axis=0), values[-1] - values[0])
        off.append((estimates - exact) / errors)
    # The standard deviation of 320 such ratios is 1, with a few heavy tails from estimated errors
    assert 0.85 < np.std(off) < 1.25


def test_one_sample_has_no_error() -> None:
    assert np.isnan(standard_error(np.ones((1, 3)))).all()
    np.testing.assert_allclose(standard_error(np.array([[1.0], [3.0]])), 1.0)
