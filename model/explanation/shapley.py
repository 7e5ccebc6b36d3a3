"""Shapley values of small games, and estimates of larger ones (Shapley 1953; Castro et al. 2009).

A game gives every coalition of its n players a value, here a vector of D numbers. The Shapley value of a
player is the mean, over all orders of the players, of what the value changes when it joins those before it.
The values of all players add up to the value of all players together minus that of none.
"""

from itertools import pairwise
from math import factorial

import numpy as np

from model.arrays import Bools, Floats, Ints


def coalitions(players: int) -> Bools:
    """Return all coalitions of n players: [2^n, n]; bit i of a row's number is player i."""
    numbers = np.arange(2**players)
    return np.asarray((numbers[:, None] >> np.arange(players)) & 1, dtype=np.bool_)


def shapley_values(values: Floats) -> Floats:
    """Return the exact Shapley values: [..., n, D].

    Args:
        values: [..., 2^n, D], values of the coalitions in the order of ``coalitions``.

    Raises:
        ValueError: the number of coalitions is no power of two.
    """
    count = values.shape[-2]
    players = count.bit_length() - 1
    if count != 2**players:
        raise ValueError(f"{count} coalitions are not those of any number of players")
    members = coalitions(players)
    sizes = members.sum(axis=1)
    result = np.zeros((*values.shape[:-2], players, values.shape[-1]))
    for player in range(players):
        without = np.flatnonzero(~members[:, player])
        # The share of orders in which exactly these players come before
        before = sizes[without].tolist()
        orders = np.array([factorial(size) * factorial(players - size - 1) for size in before])
        share = orders / factorial(players)
        gained = values[..., without + 2**player, :] - values[..., without, :]
        result[..., player, :] = (share[:, None] * gained).sum(axis=-2)
    return result


def antithetic_orders(players: int, count: int, random: np.random.Generator) -> Ints:
    """Return orders of n players, each followed by its reverse: [count, n].

    Players whose worth depends on how early they join are estimated with less variance so (Mitchell et al.
    2022, section 4).

    Args:
        players: n.
        count: number of orders, even.
        random: generator of random numbers.

    Raises:
        ValueError: the count is odd or not positive.
    """
    if count < 2 or count % 2:
        raise ValueError(f"{count} orders are not pairs of orders")
    drawn = random.permuted(np.tile(np.arange(players), (count // 2, 1)), axis=1)
    return np.stack([drawn, drawn[:, ::-1]], axis=1).reshape(count, players)


def joined(order: Ints) -> Bools:
    """Return the coalitions that an order passes through, from nobody to all: [n + 1, n]."""
    count = len(order)
    places = np.empty(count, dtype=np.int64)
    places[order] = np.arange(count)
    return np.asarray(places[None, :] < np.arange(count + 1)[:, None])


def estimated_values(orders: Ints, values: Floats) -> tuple[Floats, Floats]:
    """Return estimates of the Shapley values, and their standard errors: [n, D] each.

    An order and its reverse are one sample; the standard error is that of the mean of the samples, and NaN
    for a single one.

    Args:
        orders: [P, n], from ``antithetic_orders``.
        values: [P, n + 1, D], values of the coalitions that ``joined`` gives for each order.
    """
    count, players = orders.shape
    gains = np.zeros((count, players, values.shape[-1]))
    for order, path, gain in zip(orders, values, gains, strict=True):
        for player, (before, after) in zip(order.tolist(), pairwise(path), strict=True):
            gain[player] = after - before
    samples = gains.reshape(count // 2, 2, players, -1).mean(axis=1)
    return samples.mean(axis=0), standard_error(samples)


def standard_error(samples: Floats) -> Floats:
    """Return the standard error of the mean over the first axis: [S, ...] → [...]; NaN for one sample."""
    count = len(samples)
    if count < 2:
        return np.full(samples.shape[1:], np.nan)
    return np.asarray(samples.std(axis=0, ddof=1) / np.sqrt(count))
