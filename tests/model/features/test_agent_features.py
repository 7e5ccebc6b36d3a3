"""Features in the agents' own frames."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model.arrays import Bytes, Float32s, Ints
from model.features.agent_features import HISTORY_SCALE, NEIGHBORS, agent_frame_features
from model.features.spec import Frame
from model.forecaster import Context
from model.geometry import rotate
from model.networks.config import NetworkConfig
from model.scenes.raster import FAR, NEAR, cut_patches
from model.scenes.scene import AgentStates, AgentType, Raster, Scene
from tests.model.made_scenes import crowd, moved, present

CONFIG = NetworkConfig(frame=Frame.AGENT, far_map=True)
VEHICLES: Ints = np.arange(4)
VEHICLE, PEDESTRIAN = AgentType.VEHICLE, AgentType.PEDESTRIAN


def joined(*scenes: Scene) -> Scene:
    """One scene of the agents of several."""
    parts = [one.states for one in scenes]
    names = AgentStates.__dataclass_fields__
    states = AgentStates(**{name: np.concatenate([getattr(one, name) for one in parts]) for name in names})
    return Scene([kind for one in scenes for kind in one.types], states)


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 50),
    angle=st.floats(-10, 10),
    dx=st.floats(-1e5, 1e5),
    dy=st.floats(-1e5, 1e5),
)
def test_a_scene_that_is_turned_and_shifted_has_the_same_features(
    seed: int, angle: float, dx: float, dy: float
) -> None:
    scene = crowd(seed)
    here = agent_frame_features(scene, VEHICLES, CONFIG.features, Context.FULL)
    there = agent_frame_features(moved(scene, angle, (dx, dy)), VEHICLES, CONFIG.features, Context.FULL)
    assert here.keys() == there.keys()
    for name in here.keys() - {"origin", "heading"}:
        np.testing.assert_allclose(here[name], there[name], atol=2e-5, err_msg=name)
    np.testing.assert_allclose(
        there["origin"], rotate(here["origin"].numpy(), np.array(angle)) + np.array([dx, dy]), atol=1e-6
    )
    turned = (there["heading"] - here["heading"] - angle).numpy()
    np.testing.assert_allclose(np.cos(turned), 1.0, atol=1e-9)


def test_what_an_agent_and_its_neighbour_are_told_as() -> None:
    own = present(
        position=(100.0, 200.0),
        velocity=(0.0, 4.0),
        acceleration=(-1.0, 2.0),
        heading=np.pi / 2,
        heading_rate=0.3,
    )
    # 6 m ahead and 3 m to the left, it comes across from the left
    other = present(position=(97.0, 206.0), velocity=(5.0, 0.0), acceleration=(0.0, 1.0), heading=0.0)
    scene = joined(own, other)
    features = agent_frame_features(scene, np.array([0]), replace_maps(CONFIG).features, Context.FULL)
    assert features["speed"].tolist() == [pytest.approx(4.0)]
    history = np.array([[0.0, 0.0, 4.0, 0.0, 2.0, 1.0, 0.0, 0.3]]) / HISTORY_SCALE
    np.testing.assert_allclose(features["history"][0], history, atol=1e-6)
    place, turn, velocity, change = [6 / 30, 3 / 30], [0.0, -1.0], [0.0, -5 / 15], [1 / 4, 0.0]
    expected = [*place, *turn, *velocity, *change, 1.0, 0.0, 1.0]
    np.testing.assert_allclose(features["neighbors"][0, 0], expected, atol=1e-6)
    assert not features["neighbors"][0, 1:].any()
    assert features["heading"].dtype == features["origin"].dtype  # float64, where a place is large
    assert features["origin"].tolist() == [[100.0, 200.0]]


def replace_maps(config: NetworkConfig) -> NetworkConfig:
    """The configuration without maps."""
    return config.model_copy(update={"uses_map": False, "far_map": False})


@pytest.mark.parametrize(("velocity", "speed"), [((-3.0, 0.1), -3.0), ((0.0, 0.0), 0.0), ((0.0, 2.0), 0.0)])
def test_speed_is_signed_along_the_heading(velocity: tuple[float, float], speed: float) -> None:
    scene = present(velocity=velocity, heading=0.0)
    features = agent_frame_features(scene, np.array([0]), CONFIG.features, Context.FULL)
    assert features["speed"].item() == pytest.approx(speed)


def test_the_nearest_count_up_to_sixteen_and_sixty_metres() -> None:
    distances = np.array([61.0, *np.linspace(59.0, 2.0, 25)])
    directions = np.linspace(0, 6, len(distances))
    others = [
        present(position=(d * np.cos(a), d * np.sin(a)), heading=0.0)
        for d, a in zip(distances, directions, strict=True)
    ]
    scene = joined(present(heading=0.0), *others)
    whole = agent_frame_features(scene, np.array([0]), CONFIG.features, Context.FULL)["neighbors"][0].numpy()
    got = 30 * np.hypot(whole[:, 0], whole[:, 1])
    np.testing.assert_allclose(got, np.sort(distances)[:NEIGHBORS], rtol=1e-5)
    few = agent_frame_features(
        joined(present(heading=0.0), *others[:3]), np.array([0]), CONFIG.features, Context.FULL
    )
    np.testing.assert_array_equal(few["neighbors"][0, :, -1], [1.0] * 2 + [0.0] * (NEIGHBORS - 2))


def test_who_is_a_neighbour() -> None:
    scene = crowd()
    rows = agent_frame_features(scene, VEHICLES, CONFIG.features, Context.FULL)["neighbors"].numpy()
    for target, row in zip(VEHICLES, rows, strict=True):
        there = row[row[:, -1] > 0]
        # Not itself, not the cyclist, not who is not observed now
        assert len(there) == 6
        assert sorted(map(tuple, there[:, 8:10])) == [(0.0, 1.0)] * 2 + [(1.0, 0.0)] * 4
        assert (np.hypot(there[:, 0], there[:, 1]) > 0).all(), target
        # One heading is unknown: neither cosine nor sine
        turns = np.hypot(there[:, 2], there[:, 3])
        assert sorted(turns.round(5)) == [0.0] + [1.0] * 5
    vehicles = CONFIG.model_copy(update={"neighbor_types": (VEHICLE,)})
    rows = agent_frame_features(scene, VEHICLES, vehicles.features, Context.FULL)["neighbors"].numpy()
    assert (rows[..., -1].sum(axis=1) == 4).all()
    assert not rows[..., 9].any()


def test_what_was_not_observed_is_zero() -> None:
    scene = crowd()
    features = agent_frame_features(scene, VEHICLES, CONFIG.features, Context.FULL)
    assert features["first"].tolist() == [0, 3, 0, 0]
    assert not features["history"][1, :3].any()
    assert features["history"][1, 3].any()
    assert all(values.isfinite().all() for values in features.values())


def test_only_what_is_looked_at_is_made() -> None:
    own = {"origin", "heading", "speed", "history", "first"}
    scene = crowd()
    blind = agent_frame_features(scene, VEHICLES, CONFIG.features, Context.BLIND)
    assert blind.keys() == own
    alone = CONFIG.model_copy(update={"neighbor_types": (), "far_map": False})
    assert agent_frame_features(scene, VEHICLES, alone.features, Context.FULL).keys() == own | {"map"}
    whole = agent_frame_features(scene, VEHICLES, CONFIG.features, Context.FULL)
    assert whole.keys() == own | {"map", "far_map", "neighbors"}


def test_an_agent_without_heading_is_refused() -> None:
    with pytest.raises(ValueError, match="has no heading"):
        agent_frame_features(crowd(), np.array([0, 7]), CONFIG.features, Context.FULL)


def test_own_patches_go_before_the_raster_and_what_is_on_neither_is_unknown() -> None:
    layers = np.random.default_rng(1).integers(0, 2, (3, 60, 60), dtype=np.uint8)
    scene = crowd(2)
    raster = Raster(layers, scene.states.position[0, -1] - 10.0, 3.0)
    patches = {1: scene.patches[1]}
    far_patches: dict[int, Bytes | Float32s] = {2: (0.25 * scene.far_patches[2]).astype(np.float32)}
    mixed = replace(scene, raster=raster, patches=patches, far_patches=far_patches)
    features = agent_frame_features(mixed, VEHICLES, CONFIG.features, Context.FULL)
    position, heading = scene.states.position[:4, -1], scene.states.heading[:4, -1]
    for name, geometry, given_rows in (("map", NEAR, patches), ("far_map", FAR, far_patches)):
        cut = 2 * cut_patches(raster, position, heading, geometry, outside=0.5) - 1
        for row in range(4):
            wanted = 2 * given_rows[row].astype(np.float32) - 1 if row in given_rows else cut[row]
            np.testing.assert_allclose(features[name][row], wanted, atol=1e-5)
        assert (features[name][0] == 0).any()
        assert features[name].min() == -1
        assert features[name].max() == 1
    bare = replace(scene, patches={}, far_patches={})
    without = agent_frame_features(bare, VEHICLES, CONFIG.features, Context.FULL)
    assert not without["map"].any()
    assert not without["far_map"].any()
