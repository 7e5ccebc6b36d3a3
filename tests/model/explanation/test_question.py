"""Explanations against brute force, by their axioms, and of models that do not look around."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

import model
from model.arrays import Bytes, Float32s, Floats, Ints
from model.explanation import question
from model.explanation.donors import Donors, in_ground_frame, in_own_frame
from model.explanation.question import (
    PARTS,
    Explanation,
    ExplanationSettings,
    Part,
    ask,
    end_points,
    forecasts_needed,
)
from model.forecaster import Forecaster, complete
from model.registry import Registry
from model.scenes.scene import AgentStates, AgentType, Scene
from tests.model.explanation.made_donors import donors
from tests.model.made_scenes import crowd, moved

NETWORKS = ["cab", "trajectron", "halentnet", "covernet"]
"""In the agent's frame, and in the ground frame with summed neighbours and with boxes."""
WITHOUT_CONTEXT = ["trajectron-no-context", "kalman", "constant-velocity-yaw"]
TARGET = 0


@cache
def registry() -> Registry:
    return Registry.load(Path(model.__file__).parent / "checkpoints")


def explain(
    forecaster: Forecaster, scene: Scene, settings: ExplanationSettings, target: int = TARGET
) -> Explanation:
    asked = ask(forecaster, scene, target, settings)
    needed = forecasts_needed(int(forecaster.sees(scene, np.array([target])).sum()), settings)
    assert len(asked.inputs) <= needed
    mixture = forecaster.forecast(complete([asked.inputs]), scene.types[target])
    return asked.answer(end_points(mixture))


def end_point(forecaster: Forecaster, scene: Scene, target: int = TARGET) -> Floats:
    """Return where the forecast of an agent ends: [2]."""
    point: Floats = end_points(forecaster(scene, np.array([target])))[0]
    return point


def same_speed(scene: Scene, *others: float) -> Donors:
    """Return two donors as fast as the target, and some of other speeds."""
    speed = float(np.linalg.norm(scene.states.velocity[TARGET, -1]))
    return donors(speed, speed + 0.5, *others)


def selected(scene: Scene, others: Ints | list[int]) -> Scene:
    """Return the target, which comes first, and some others."""
    kept = np.array([TARGET, *others], dtype=np.int64)
    patches: list[dict[int, Bytes | Float32s]] = [
        {0: given[TARGET]} if TARGET in given else {} for given in (scene.patches, scene.far_patches)
    ]
    return Scene([scene.types[i] for i in kept.tolist()], scene.states.select(kept), None, *patches)


def joined(one: AgentStates, others: AgentStates) -> AgentStates:
    values = {name: np.concatenate([getattr(one, name), getattr(others, name)]) for name in vars(one)}
    return AgentStates(**values)


def absent(
    scene: Scene, coalition: frozenset[Part], donor: tuple[Donors, int] | None, neighbors: list[int]
) -> Scene:
    """Return the scene with the parts outside of a coalition taken from a donor, or absent."""
    states = scene.states
    position, heading = states.position[TARGET, -1], float(states.heading[TARGET, -1])
    now = selected(scene, neighbors)
    own = states.select(np.array([TARGET]))
    if Part.STATE not in coalition:
        history = np.zeros((1, states.frames, 8)) if donor is None else donor[0].history[donor[1]][None]
        own = in_ground_frame(history, position, heading, states.frames)
    kinds, others = now.types[1:], now.states.select(np.arange(1, len(now.types)))
    if Part.NEIGHBORS not in coalition:
        if donor is None:
            kinds, others = [], others.select(np.zeros(0, dtype=np.int64))
        else:
            given, index = donor
            count = min(len(neighbors), 3)
            kinds = [(AgentType.VEHICLE, AgentType.PEDESTRIAN)[k] for k in given.kinds[index, :count]]
            others = in_ground_frame(given.neighbors[index, :count], position, heading, states.frames)
    near, far = now.patches, now.far_patches
    if Part.MAP not in coalition:
        near = {} if donor is None else {0: donor[0].near[donor[1]]}
        far = {} if donor is None else {0: donor[0].far[donor[1]]}
    return Scene([scene.types[TARGET], *kinds], joined(own, others), None, near, far)


def brute_force(
    forecaster: Forecaster, scene: Scene, given: Donors | None, pairs: Sequence[tuple[int, int]]
) -> dict[Part, Floats]:
    """Return the mean gain of each part over all orders and draws: [3] each.

    Args:
        forecaster: the model.
        scene: the scene.
        given: donors; None: the null context.
        pairs: for each draw, the donor where the own state is present, and that where it is absent.
    """
    position, heading = scene.states.position[TARGET, -1], float(scene.states.heading[TARGET, -1])
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    neighbors = seen(forecaster, scene)
    final = end_point(forecaster, selected(scene, neighbors))
    total = dict.fromkeys(PARTS, np.zeros(3))
    orders = list(permutations(PARTS))
    for matched, other in pairs:
        values: dict[frozenset[Part], Floats] = {}
        for order in orders:
            for end in range(len(PARTS) + 1):
                coalition = frozenset(order[:end])
                donor = None if given is None else (given, matched if Part.STATE in coalition else other)
                changed = absent(scene, coalition, donor, neighbors)
                point = final if end == len(PARTS) else end_point(forecaster, changed)
                values[coalition] = np.array([-np.linalg.norm(point - final), *(turn @ (point - position))])
        for order in orders:
            for end, part in enumerate(order):
                gain = values[frozenset(order[: end + 1])] - values[frozenset(order[:end])]
                total[part] = total[part] + gain / len(orders) / len(pairs)
    return total


def seen(forecaster: Forecaster, scene: Scene) -> list[int]:
    found: list[int] = np.flatnonzero(forecaster.sees(scene, np.array([TARGET]))[0]).tolist()
    return found


@pytest.fixture(params=NETWORKS)
def network(request: pytest.FixtureRequest) -> Forecaster:
    return registry().get(request.param)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return crowd(seed=3)


def test_the_null_context_equals_brute_force(network: Forecaster, scene: Scene) -> None:
    explained = explain(network, scene, ExplanationSettings())
    expected = brute_force(network, scene, None, [(0, 0)])
    for part in PARTS:
        np.testing.assert_allclose(explained.parts[part].value, expected[part], atol=2e-3)
        assert not explained.parts[part].error.any()
    assert explained.draws == 0


def test_donors_equal_brute_force(network: Forecaster, scene: Scene) -> None:
    """With the own state present donors are in random order, without it they are ordered by speed."""
    given = same_speed(scene)
    states = scene.states
    own = in_own_frame(
        states, np.array([TARGET]), states.position[TARGET, -1], float(states.heading[TARGET, -1])
    )[0]
    like = given.matching(own, len(seen(network, scene)), np.random.default_rng(0)).tolist()
    explained = explain(network, scene, ExplanationSettings(given, draws=2))
    expected = brute_force(network, scene, given, list(zip(like, [0, 1], strict=True)))
    for part in PARTS:
        np.testing.assert_allclose(explained.parts[part].value, expected[part], atol=2e-3)
    assert explained.draws == 2


@pytest.mark.parametrize("with_donors", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_parts_add_up_to_the_way_from_nothing_to_everything(seed: int, with_donors: bool) -> None:
    scene = crowd(seed=seed)
    given = same_speed(scene, 1.0, 4.0, 12.0) if with_donors else None
    explained = explain(registry().get("cab"), scene, ExplanationSettings(given, draws=4))
    total = sum(value.value for value in explained.parts.values())
    assert isinstance(total, np.ndarray)
    heading = float(scene.states.heading[TARGET, -1])
    way = explained.end_point - explained.base_point
    ahead = np.array([np.cos(heading), np.sin(heading)]) @ way
    left = np.array([-np.sin(heading), np.cos(heading)]) @ way
    np.testing.assert_allclose(total[1:], [ahead, left], atol=1e-9)
    if not with_donors:
        np.testing.assert_allclose(total[0], np.linalg.norm(way), atol=1e-9)
    else:
        assert total[0] >= np.linalg.norm(way) - 1e-9  # a mean distance, to a mean point
        assert explained.parts[Part.STATE].error.all()


def test_the_end_point_is_that_of_the_forecast(network: Forecaster, scene: Scene) -> None:
    explained = explain(network, scene, ExplanationSettings())
    np.testing.assert_allclose(explained.end_point, end_point(network, scene), atol=1e-3)


@pytest.mark.parametrize("name", WITHOUT_CONTEXT)
@pytest.mark.parametrize("with_donors", [False, True])
def test_without_context_map_and_neighbors_are_exactly_nothing(
    name: str, scene: Scene, with_donors: bool
) -> None:
    given = same_speed(scene, 1.0, 4.0) if with_donors else None
    explained = explain(registry().get(name), scene, ExplanationSettings(given, by_neighbor=True))
    for part in (Part.MAP, Part.NEIGHBORS):
        assert not explained.parts[part].value.any()
        assert not explained.parts[part].error.any()
    assert all(not value.value.any() for value in explained.by_neighbor.values())
    assert explained.parts[Part.STATE].value[0] > 0


def test_no_map_and_nobody_around_are_exactly_nothing(network: Forecaster, scene: Scene) -> None:
    alone = replace(selected(scene, []), patches={}, far_patches={})
    explained = explain(network, alone, ExplanationSettings(same_speed(scene), by_neighbor=True))
    for part in (Part.MAP, Part.NEIGHBORS):
        assert not explained.parts[part].value.any()
    assert not explained.by_neighbor


def with_decoys(scene: Scene) -> Scene:
    """Return the scene with vehicles at 61 m and 300 m, farther than any model looks, between the others."""
    states = scene.states
    far = states.select(np.array([1, 3]))
    offset = np.array([[61.0, 0.0], [300.0, 0.0]]) - far.position[:, -1] + states.position[TARGET, -1]
    far = replace(far, position=far.position + offset[:, None])
    order = np.array([0, 9, 1, 2, 3, 4, 10, 5, 6, 7, 8])
    types = [*scene.types, AgentType.VEHICLE, AgentType.VEHICLE]
    new = joined(states, far).select(order)
    moved_to = {int(old): place for place, old in enumerate(order)}
    near, distant = (
        {moved_to[old]: patch for old, patch in given.items()} for given in (scene.patches, scene.far_patches)
    )
    return Scene([types[old] for old in order.tolist()], new, None, near, distant)


def test_a_decoy_beyond_the_attention_radius_is_exactly_nothing(network: Forecaster, scene: Scene) -> None:
    settings = ExplanationSettings(same_speed(scene), 2, by_neighbor=True, permutations=4)
    plain, decoyed = explain(network, scene, settings), explain(network, with_decoys(scene), settings)
    for decoy in (1, 6):
        assert not decoyed.by_neighbor[decoy].value.any()
        assert not decoyed.by_neighbor[decoy].error.any()
    for part in PARTS:
        np.testing.assert_allclose(decoyed.parts[part].value, plain.parts[part].value, atol=1e-6)
    places = {1: 2, 2: 3, 3: 4, 4: 5, 5: 7, 6: 8, 7: 9}
    assert set(plain.by_neighbor) == set(places)  # all that are observed now
    for old, new in places.items():
        np.testing.assert_allclose(decoyed.by_neighbor[new].value, plain.by_neighbor[old].value, atol=1e-6)


def subsets(items: list[int]) -> Iterator[tuple[int, ...]]:
    for number in range(2 ** len(items)):
        yield tuple(item for place, item in enumerate(items) if number >> place & 1)


def neighbors_by_definition(forecaster: Forecaster, scene: Scene) -> dict[int, float]:
    """Return how much nearer each neighbour brings the end point, by all orders."""
    players = seen(forecaster, scene)
    final = end_point(forecaster, selected(scene, players))
    worth = {
        some: -float(np.linalg.norm(end_point(forecaster, selected(scene, list(some))) - final))
        for some in subsets(players)
    }
    total = dict.fromkeys(players, 0.0)
    orders = list(permutations(players))
    for order in orders:
        for place, player in enumerate(order):
            before, after = tuple(sorted(order[:place])), tuple(sorted(order[: place + 1]))
            total[player] += (worth[after] - worth[before]) / len(orders)
    return total


@pytest.mark.parametrize("name", ["trajectron", "halentnet"])
def test_values_of_few_neighbors_equal_brute_force(name: str, scene: Scene) -> None:
    few = selected(scene, [1, 2, 4, 5])
    expected = neighbors_by_definition(registry().get(name), few)
    explained = explain(registry().get(name), few, ExplanationSettings(by_neighbor=True))
    assert len(expected) > 1
    assert explained.permutations == 0
    for index, value in expected.items():
        np.testing.assert_allclose(explained.by_neighbor[index].value[0], value, atol=2e-3)


def test_values_of_many_neighbors_are_near_the_exact_ones(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    cab = registry().get("cab")
    exact = explain(cab, scene, ExplanationSettings(by_neighbor=True)).by_neighbor
    monkeypatch.setattr(question, "EXACT_NEIGHBORS", 2)
    drawn = explain(cab, scene, ExplanationSettings(by_neighbor=True, permutations=32, seed=5))
    assert drawn.permutations == 32
    for index, value in drawn.by_neighbor.items():
        assert (np.abs(value.value - exact[index].value) <= 5 * value.error + 1e-6).all()
    total = sum(value.value for value in drawn.by_neighbor.values())
    np.testing.assert_allclose(total, sum(value.value for value in exact.values()), atol=1e-6)


@pytest.mark.parametrize("name", [*NETWORKS, *WITHOUT_CONTEXT])
def test_who_is_seen_is_who_changes_the_features(name: str) -> None:
    forecaster = registry().get(name)
    for seed in range(6):
        scene = crowd(seed=seed)
        alone = complete([forecaster.view(selected(scene, []), np.array([0]))])
        told = seen(forecaster, scene)
        changes = []
        for other in range(1, len(scene.types)):
            two = complete([forecaster.view(selected(scene, [other]), np.array([0]))])
            if any((two[feature] != alone[feature]).any() for feature in alone):
                changes.append(other)
        assert told == changes


@pytest.mark.parametrize("name", ["cab"])
def test_a_scene_turned_and_shifted_is_explained_alike(name: str, scene: Scene) -> None:
    settings = ExplanationSettings(same_speed(scene, 3.0, 8.0), by_neighbor=True)
    one = explain(registry().get(name), scene, settings)
    other = explain(registry().get(name), moved(scene, 2.0, (5000.0, -300.0)), settings)
    for part in PARTS:
        np.testing.assert_allclose(other.parts[part].value, one.parts[part].value, atol=5e-3)


def test_an_agent_without_donors_has_the_null_context(scene: Scene) -> None:
    cab = registry().get("cab")
    explained = explain(cab, scene, ExplanationSettings(donors(50.0, 51.0, 60.0)))
    plain = explain(cab, scene, ExplanationSettings())
    assert explained.draws == 0
    for part in PARTS:
        np.testing.assert_array_equal(explained.parts[part].value, plain.parts[part].value)


def test_agents_of_other_types_have_the_null_context() -> None:
    scene = crowd()
    explained = explain(registry().get("kalman"), scene, ExplanationSettings(donors(1.0, 2.0, 3.0)), target=4)
    assert explained.draws == 0
    assert explained.parts[Part.STATE].value[0] > 0
