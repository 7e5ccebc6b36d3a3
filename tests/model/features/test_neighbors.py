"""Edges and what neighbours add."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.arrays import Floats
from model.features.neighbors import edge_ramps, neighbor_sums
from model.features.standardization import ATTENTION_RADIUS, HEADING, state_scale, state_vectors
from model.geometry import rotate, wrap_angle
from model.scenes.scene import AgentStates, AgentType

VEHICLE, PEDESTRIAN = AgentType.VEHICLE, AgentType.PEDESTRIAN
FRAMES = 5


def states(position: Floats, first: list[int] | None = None, seed: int = 0) -> AgentStates:
    """States at [N, F, 2] positions with random derivatives."""
    rng = np.random.default_rng(seed)
    agents, frames = position.shape[:2]
    begin = np.array(first or [0] * agents)
    seen = np.arange(frames)[None] >= begin[:, None]

    def values(*shape: int) -> Floats:
        drawn = rng.normal(size=(agents, frames, *shape))
        drawn[~seen] = np.nan
        return drawn

    position = np.where(seen[..., None], position, np.nan)
    return AgentStates(position, values(2), values(2), values(), values(), begin, begin < frames)


def apart(distances: list[float]) -> AgentStates:
    """Agent 0 stays at the origin, agent 1 is that far at each frame."""
    position = np.zeros((2, len(distances), 2))
    position[1, :, 1] = distances
    return states(position)


@pytest.mark.parametrize(
    ("inside", "ramp"),
    [
        ([0, 0, 0, 0, 1], 0.25),
        ([0, 0, 0, 1, 1], 0.75),
        ([0, 0, 1, 1, 1], 1.0),
        ([1, 1, 1, 1, 0], 0.0),
        ([0, 0, 1, 0, 1], 1.0),
        ([0, 1, 0, 0, 1], 1.0),
        ([1, 0, 0, 0, 1], 0.25),
    ],
)
def test_an_edge_fades_in_and_ends_at_once(inside: list[int], ramp: float) -> None:
    radius = ATTENTION_RADIUS[VEHICLE, VEHICLE]
    s = apart([radius - 1 if there else radius + 1 for there in inside])
    edges = edge_ramps(s, np.array([0]), VEHICLE, np.array([0, 1]), VEHICLE)
    np.testing.assert_allclose(edges, [[0, ramp]])


def test_a_pedestrian_counts_twice() -> None:
    s = apart([99, 99, 99, 99, 3])
    assert edge_ramps(s, np.array([0]), VEHICLE, np.array([1]), PEDESTRIAN)[0, 0] == 0.5
    assert edge_ramps(s, np.array([0]), PEDESTRIAN, np.array([1]), VEHICLE)[0, 0] == 0.25


@pytest.mark.parametrize(("own", "other"), list(ATTENTION_RADIUS))
def test_radius(own: AgentType, other: AgentType) -> None:
    radius = ATTENTION_RADIUS[own, other]
    for distance, edge in ((radius - 0.01, 1.0), (radius + 0.01, 0.0)):
        s = apart([distance] * FRAMES)
        assert edge_ramps(s, np.array([0]), own, np.array([1]), other)[0, 0] == edge


def test_frames_not_observed_do_not_count() -> None:
    position = np.zeros((2, FRAMES, 2))
    for first, ramp in ((4, 0.25), (3, 0.75), (2, 1.0), (5, 0.0)):
        s = states(position, [0, first])
        assert edge_ramps(s, np.array([0]), VEHICLE, np.array([1]), VEHICLE)[0, 0] == ramp


@given(
    st.integers(0, 10_000),
    st.sampled_from([VEHICLE, PEDESTRIAN]),
    st.sampled_from([VEHICLE, PEDESTRIAN]),
    st.floats(-1e5, 1e5),
)
def test_sums_are_the_sum_over_neighbours_wherever_the_origin_is(
    seed: int, own: AgentType, other: AgentType, shift: float
) -> None:
    rng = np.random.default_rng(seed)
    agents = 6
    first = rng.integers(0, FRAMES + 1, agents)
    first[0] = 0
    position = rng.uniform(-20, 20, (agents, FRAMES, 2))
    near, far = states(position, list(first), seed), states(position + shift, list(first), seed)
    targets, neighbors = np.array([0]), np.arange(1, agents)
    edges = edge_ramps(near, targets, own, neighbors, other)
    np.testing.assert_array_equal(edges > 0, edge_ramps(far, targets, own, neighbors, other) > 0)

    expected = np.zeros((FRAMES, len(state_scale(own, other))))
    now = state_vectors(near, own)[0, -1]
    for j, edge in zip(neighbors, edges[0], strict=True):
        if edge > 0:
            relative = state_vectors(near, other)[j]
            common = min(relative.shape[1], len(now))
            relative[:, :common] -= now[:common]
            if common > HEADING:
                relative[:, HEADING] = wrap_angle(relative[:, HEADING])
            expected += np.nan_to_num(relative / state_scale(own, other))
    for s in (near, far):
        sums = neighbor_sums(s, targets, own, neighbors, other, edges)
        np.testing.assert_allclose(sums[0], expected, rtol=0, atol=1e-8)


def test_no_neighbours_sum_to_zero() -> None:
    s = states(np.zeros((1, FRAMES, 2)))
    none = np.array([], dtype=np.int64)
    edges = edge_ramps(s, np.array([0]), VEHICLE, none, VEHICLE)
    assert edges.shape == (1, 0)
    assert not neighbor_sums(s, np.array([0]), VEHICLE, none, VEHICLE, edges).any()


@given(st.floats(-7, 7))
def test_turning_the_frame_turns_positions_and_keeps_relative_headings(angle: float) -> None:
    rng = np.random.default_rng(3)
    plain = states(rng.uniform(-9, 9, (4, FRAMES, 2)))
    vectors = [plain.position, plain.velocity, plain.acceleration]
    position, velocity, acceleration = (rotate(values, np.array(angle)) for values in vectors)
    heading = wrap_angle(plain.heading + angle)
    turned = AgentStates(
        position, velocity, acceleration, heading, plain.heading_rate, plain.first, plain.velocity_known
    )
    targets, others = np.array([0]), np.arange(1, 4)
    sums = []
    for s in (plain, turned):
        edges = edge_ramps(s, targets, VEHICLE, others, VEHICLE)
        sums.append(neighbor_sums(s, targets, VEHICLE, others, VEHICLE, edges)[0])
    for at in (0, 2, 4):
        expected = rotate(sums[0][:, at : at + 2], np.array(angle))
        np.testing.assert_allclose(sums[1][:, at : at + 2], expected, atol=1e-9)
    np.testing.assert_allclose(sums[1][:, 7], sums[0][:, 7], atol=1e-9)
    # By the shorter arc: alike unless a difference is just half a turn, where either way is right
    assert (np.abs(sums[1][:, HEADING] - sums[0][:, HEADING]) < 1e-9).all()
