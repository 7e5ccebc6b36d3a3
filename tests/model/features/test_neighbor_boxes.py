"""The agents around, as boxes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.arrays import Floats
from model.features.neighbor_boxes import BOX_SIZE, BOXES, neighbor_boxes
from model.geometry import rotate, wrap_angle
from model.scenes.scene import AgentStates, AgentType, Scene

BOTH = (AgentType.VEHICLE, AgentType.PEDESTRIAN)
OWN = np.array([0])


def scene(places: Floats, headings: Floats, types: list[AgentType]) -> Scene:
    """Agents at places [N, 2] with headings [N], seen for two frames."""
    count = len(places)
    position = np.repeat(places[:, None], 2, axis=1)
    zeros = np.zeros_like(position)
    states = AgentStates(
        position=position,
        velocity=zeros,
        acceleration=zeros,
        heading=np.repeat(headings[:, None], 2, axis=1),
        heading_rate=zeros[..., 0],
        first=np.zeros(count, dtype=np.int64),
        velocity_known=np.ones(count, dtype=np.bool_),
    )
    return Scene(types, states)


def some(seed: int = 0, count: int = 12) -> Scene:
    """Agents all about; the first is a vehicle."""
    rng = np.random.default_rng(seed)
    types = [AgentType.VEHICLE, *(BOTH[int(one)] for one in rng.integers(0, 2, count - 1))]
    return scene(rng.uniform(-25, 25, (count, 2)), rng.uniform(-3, 3, count), types)


def test_boxes_are_in_the_agents_frame() -> None:
    places = np.array([[10.0, 20.0], [10.0, 25.0], [7.0, 20.0]])
    types = [AgentType.VEHICLE, AgentType.VEHICLE, AgentType.PEDESTRIAN]
    around = scene(places, np.array([np.pi / 2, np.pi, 0.0]), types)
    boxes = neighbor_boxes(around, OWN, BOTH)[0]
    np.testing.assert_allclose(boxes[0], [0, 3, -np.pi / 2, *BOX_SIZE[AgentType.PEDESTRIAN]], atol=1e-6)
    np.testing.assert_allclose(boxes[1], [5, 0, np.pi / 2, *BOX_SIZE[AgentType.VEHICLE]], atol=1e-6)
    assert not boxes[2:].any()


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 100), angle=st.floats(-4, 4), x=st.floats(-1e5, 1e5))
def test_how_the_ground_frame_lies_does_not_matter(seed: int, angle: float, x: float) -> None:
    plain = some(seed)
    states = replace(
        plain.states,
        position=rotate(plain.states.position, np.array(angle)) + x,
        heading=wrap_angle(plain.states.heading + angle),
    )
    moved = neighbor_boxes(replace(plain, states=states), OWN, BOTH)
    wanted = neighbor_boxes(plain, OWN, BOTH)
    difference = moved - wanted
    difference[..., 2] = wrap_angle(difference[..., 2].astype(np.float64))
    np.testing.assert_allclose(difference, 0, atol=1e-4)


def test_the_nearest_of_many_are_kept_in_order() -> None:
    count = BOXES + 8
    places = np.zeros((count, 2))
    places[1:, 0] = np.random.default_rng(0).permutation(np.linspace(1, 25, count - 1))
    boxes = neighbor_boxes(scene(places, np.zeros(count), [AgentType.VEHICLE] * count), OWN, BOTH)[0]
    np.testing.assert_allclose(boxes[:, 0], np.sort(places[1:, 0])[:BOXES], rtol=1e-6)


@pytest.mark.parametrize(
    ("place", "seen"),
    [
        ((29.0, 0.0), True),
        ((40.0, 0.0), False),
        ((-5.0, 0.0), True),
        ((-9.0, 0.0), False),
        ((0, 20.0), False),
    ],
)
def test_what_does_not_reach_into_the_patch_is_left_out(place: tuple[float, float], seen: bool) -> None:
    around = scene(np.array([(0.0, 0.0), place]), np.zeros(2), [AgentType.VEHICLE] * 2)
    assert neighbor_boxes(around, OWN, BOTH).any() == seen


def test_only_the_wanted_and_the_present_are_told() -> None:
    around = scene(
        np.array([[0.0, 0.0], [3.0, 0.0], [5.0, 0.0], [7.0, 0.0]]),
        np.zeros(4),
        [AgentType.VEHICLE, AgentType.PEDESTRIAN, AgentType.VEHICLE, AgentType.CYCLIST],
    )
    around.states.position[2] = np.nan
    told = neighbor_boxes(around, OWN, BOTH)[0]
    assert (told[:, 3] > 0).sum() == 1
    assert told[0, 0] == 3.0
    assert not neighbor_boxes(around, OWN, (AgentType.VEHICLE,)).any()
    assert neighbor_boxes(around, OWN[:0], BOTH).shape == (0, BOXES, 5)


def test_a_box_without_heading_lies_as_the_agent_does() -> None:
    around = scene(np.array([[0.0, 0.0], [0.0, 9.0]]), np.array([1.5, np.nan]), [AgentType.VEHICLE] * 2)
    boxes = neighbor_boxes(around, OWN, BOTH)
    assert np.isfinite(boxes).all()
    assert boxes[0, 0, 2] == 0.0
    assert boxes[0, 0, 3] > 0
