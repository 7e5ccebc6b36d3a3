"""Requests are what a driving stack would send: the server sees what training sees."""

from dataclasses import replace

import numpy as np
import pytest

from benchmark.plan import Call
from benchmark.requests import SceneRequests, crop
from cab.forecast.v1.prediction_service_pb2 import PredictRequest
from cab_forecast.layers import decode_layers
from model.arrays import Floats
from model.data.protocols import SceneFrames
from model.features.scene_features import ground_frame_features
from model.forecaster import Context, Protocol
from model.networks.config import NetworkConfig
from model.scenes.raster import FAR, NEAR, PatchGeometry, cut_patches
from model.scenes.resample import resample
from model.scenes.scene import AgentStates, AgentType, Raster, Scene
from service.predict.request import read_agents
from service.settings import Settings
from tests.benchmark.scenes import planned
from tests.model.data.records import raster

FRAME = 9
FIELDS = ("position", "velocity", "acceleration", "heading", "heading_rate", "first")


def request(protocol: Protocol, frame: int = FRAME) -> tuple[PredictRequest, Call]:
    """The request about a frame of the first scene."""
    scene = planned()[0]
    (call,) = (call for call in scene.calls if call.frame == frame)
    return SceneRequests(scene, protocol, 5).request(call), call


@pytest.mark.parametrize("protocol", Protocol)
def test_the_server_reads_the_states_that_training_sees(protocol: Protocol) -> None:
    sent, _ = request(protocol)
    scene, _ = SceneFrames(planned()[0].record, protocol, 5).at(FRAME)
    read = read_agents(sent, Settings())
    assert read.observations is not None
    states: AgentStates = resample(read.observations, sent.time, 5)
    for field in FIELDS:
        np.testing.assert_allclose(getattr(states, field), getattr(scene.states, field), atol=1e-9)


def test_all_agents_are_sent_and_the_requested_ones_marked() -> None:
    sent, call = request(Protocol.CAUSAL)
    record = planned()[0].record
    there = [track.id for track in record.tracks if FRAME in track.frames]
    assert [agent.id for agent in sent.agents] == there
    assert "a4" in there  # the pedestrian
    assert [agent.id for agent in sent.agents if agent.predict] == [record.tracks[i].id for i in call.tracks]
    assert sent.time == FRAME / 2
    assert not sent.model


@pytest.mark.parametrize("protocol", Protocol)
def test_derivatives_go_along_by_the_paper_protocol_alone(protocol: Protocol) -> None:
    sent, _ = request(protocol)
    for agent in sent.agents:
        for state in agent.states:
            assert state.HasField("velocity_x") is (protocol is Protocol.PAPER)
            assert state.HasField("acceleration_x") is (protocol is Protocol.PAPER)
            assert state.HasField("heading_rate") is (protocol is Protocol.PAPER)
            assert state.HasField("heading")
            assert state.time <= sent.time


def test_causal_requests_do_not_know_the_future() -> None:
    """Positions after the frame change nothing."""
    scene = planned()[0]
    changed = [
        replace(one, position=np.where((one.frames > FRAME)[:, None], 0.0, one.position))
        for one in scene.record.tracks
    ]
    other = replace(scene, record=replace(scene.record, tracks=changed))
    (call,) = (call for call in scene.calls if call.frame == FRAME)
    sent = [SceneRequests(one, Protocol.CAUSAL, 5).request(call) for one in (scene, other)]
    assert sent[0] == sent[1]


def patches(raster: Raster, protocol: Protocol = Protocol.CAUSAL) -> Floats:
    """Map patches of the requested agents, as a network gets them."""
    scene, tracks = SceneFrames(planned()[0].record, protocol, 5).at(FRAME)
    _, call = request(protocol)
    seen = Scene(scene.types, scene.states, raster)
    targets = np.searchsorted(tracks, call.tracks)
    features = ground_frame_features(seen, targets, AgentType.VEHICLE, NetworkConfig().features, Context.FULL)
    return features["map"].numpy().astype(np.float64)


def test_the_part_of_the_map_that_is_sent_shows_the_same() -> None:
    whole = raster(900, 960, (850.0, 1840.0))
    scene = planned()[0]
    scene = replace(scene, record=replace(scene.record, raster=whole))
    (call,) = (call for call in scene.calls if call.frame == FRAME)
    part = SceneRequests(scene, Protocol.CAUSAL, 5).request(call).scene_raster
    assert part.rows * part.columns < 0.5 * whole.layers[0].size
    layers = decode_layers(part.image, part.rows, part.columns).astype(np.uint8)
    cut = Raster(layers, np.array([part.origin_x, part.origin_y]), part.pixels_per_meter)
    np.testing.assert_allclose(patches(cut), patches(whole), atol=1e-6)


@pytest.mark.parametrize("pixels_per_meter", [3.0, 10.0])
@pytest.mark.parametrize("geometry", [NEAR, FAR])
def test_coarse_pixels_of_the_part_are_those_of_the_map(
    pixels_per_meter: float, geometry: PatchGeometry
) -> None:
    """Patches of a finer raster are cut from coarse pixels, which are counted from its corner."""
    generator = np.random.default_rng(0)
    size = int(240 * pixels_per_meter)
    layers = (generator.random((3, size, size)) < 0.05).astype(np.uint8)
    whole = Raster(layers, np.array([300.0, 400.0]), pixels_per_meter)
    for _ in range(5):
        position = whole.origin + generator.uniform(100, 140, (1, 2))
        part, heading = crop(whole, position), generator.uniform(-3, 3, 1)
        assert part.layers.size < 0.6 * layers.size
        shown, expected = (cut_patches(one, position, heading, geometry, 0.5) for one in (part, whole))
        np.testing.assert_allclose(shown, expected, atol=1e-5)


def test_off_the_map_nothing_is_driveable() -> None:
    """An unknown map is another thing."""
    whole = raster(origin=(5000.0, 5000.0))
    part = crop(whole, planned()[0].origin())
    assert part.layers.shape[1:] == (1, 1)
    np.testing.assert_array_equal(patches(part), patches(whole))
    assert (patches(part) == -1).all()
