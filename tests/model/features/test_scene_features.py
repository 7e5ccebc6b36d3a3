"""Features by specification: the frame, the neighbours and the map that a network asks for."""

from dataclasses import replace

import numpy as np
import pytest

from model.arrays import Ints
from model.features.scene_features import network_features
from model.features.spec import FeatureSpec, Frame
from model.forecaster import Context
from model.networks.config import CoverNetConfig, NetworkConfig
from model.scenes.raster import NEAR, map_patches
from model.scenes.scene import AgentType, Raster, Scene
from tests.model.made_scenes import crowd

VEHICLES: Ints = np.arange(4)
VEHICLE, PEDESTRIAN = AgentType.VEHICLE, AgentType.PEDESTRIAN
BOTH = (VEHICLE, PEDESTRIAN)
OWN = {"origin", "velocity", "history", "first"}
HISTORIES = {"neighbors.vehicle", "neighbors.pedestrian", "edge_mask"}


@pytest.mark.parametrize(
    ("spec", "names"),
    [
        (FeatureSpec(Frame.GROUND, (), uses_map=False), OWN),
        (FeatureSpec(Frame.GROUND, (), uses_map=True), OWN | {"map"}),
        (FeatureSpec(Frame.GROUND, BOTH, uses_map=False), OWN | HISTORIES),
        (
            FeatureSpec(Frame.GROUND, BOTH, uses_map=True, neighbor_boxes=True),
            OWN | {"neighbor_boxes", "map"},
        ),
        (FeatureSpec(Frame.GROUND, (), uses_map=False, neighbor_boxes=True), OWN),
        (
            FeatureSpec(Frame.AGENT, BOTH, uses_map=True, far_map=True),
            {"origin", "heading", "speed", "history", "first", "neighbors", "map", "far_map"},
        ),
    ],
)
def test_a_network_gets_what_it_asks_for(spec: FeatureSpec, names: set[str]) -> None:
    features = network_features(crowd(), VEHICLES, VEHICLE, spec, Context.FULL)
    assert features.keys() == names
    blind = network_features(crowd(), VEHICLES, VEHICLE, spec, Context.BLIND)
    assert blind.keys() == names - HISTORIES - {"neighbors", "neighbor_boxes", "map", "far_map"}


def test_pedestrians_have_no_map() -> None:
    spec = FeatureSpec(Frame.GROUND, (), uses_map=True)
    pedestrians = np.flatnonzero(crowd().of_type(PEDESTRIAN))
    assert len(pedestrians)
    assert "map" not in network_features(crowd(), pedestrians, PEDESTRIAN, spec, Context.FULL)


def test_configurations_of_networks_state_their_features() -> None:
    assert NetworkConfig().features == FeatureSpec(Frame.GROUND, BOTH, uses_map=True)
    agent = NetworkConfig(frame=Frame.AGENT, far_map=True, uses_map=False, neighbor_types=(VEHICLE,))
    assert agent.features == FeatureSpec(Frame.AGENT, (VEHICLE,), uses_map=False, far_map=True)
    assert CoverNetConfig().features == FeatureSpec(Frame.GROUND, BOTH, uses_map=True, neighbor_boxes=True)


@pytest.mark.parametrize("outside", [0.0, 0.5])
def test_patches_are_given_or_cut_or_unknown(outside: float) -> None:
    scene = replace(crowd(), raster=None, patches={})
    assert not map_patches(scene, VEHICLES, {}, NEAR, outside).any()
    given = np.ones((3, 100, 100), dtype=np.uint8)
    scene = _on_an_empty_raster(scene)
    patches = map_patches(scene, VEHICLES[:2], {1: given}, NEAR, outside)
    assert (patches[1] == 1).all()
    # The raster covers the agent's own place and nothing beyond
    assert patches[0, :, 10, 50] == pytest.approx(-1, abs=1e-5)
    assert patches[0, :, 99, 99] == pytest.approx(2 * outside - 1)


def _on_an_empty_raster(scene: Scene) -> Scene:
    """Put a raster of 6 × 6 m without anything on it around the first agent."""
    origin = scene.states.position[0, -1] - 3.0
    return replace(scene, raster=Raster(np.zeros((3, 18, 18), dtype=np.uint8), origin, 3.0))
