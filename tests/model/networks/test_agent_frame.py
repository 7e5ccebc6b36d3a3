"""The network in the agent's frame."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from loadtest.forward import cab_network, features_in_agent_frame
from model.checkpoint import load_checkpoint, save_checkpoint
from model.features.agent_features import agent_frame_features
from model.features.spec import Frame
from model.forecaster import Context, Features
from model.networks.agent_frame import STEPS, AgentFrameNetwork, Modes, drive, read_patch
from model.networks.config import BlindContext, NetworkConfig
from model.networks.forecaster import CvaeForecaster, CvaeNetworks
from model.scenes.raster import FAR, NEAR, PatchGeometry
from model.scenes.scene import AgentType
from tests.model.made_scenes import crowd, moved

CONFIG = NetworkConfig(frame=Frame.AGENT, far_map=True, blind=BlindContext.NULL)
VEHICLES = np.arange(4)


@pytest.fixture
def network() -> AgentFrameNetwork:
    """One with random parameters, larger than it begins with, so that all of them show."""
    torch.manual_seed(1)
    network = AgentFrameNetwork(CONFIG).eval()
    with torch.no_grad():
        for head in (network.refine, network.sigma, network.logits, network.mode_logits):
            head.weight.mul_(20)
    return network


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 20), angle=st.floats(-7, 7), dx=st.floats(-1e5, 1e5), dy=st.floats(-1e5, 1e5))
def test_a_scene_that_is_turned_and_shifted_is_forecast_so(
    seed: int, angle: float, dx: float, dy: float
) -> None:
    torch.manual_seed(1)
    network = AgentFrameNetwork(CONFIG).eval()
    forecasts = []
    for scene in (crowd(seed), moved(crowd(seed), angle, (dx, dy))):
        features = agent_frame_features(scene, VEHICLES, CONFIG.features, Context.FULL)
        with torch.no_grad():
            log_weights, positions = network(features, Context.FULL, STEPS)
        forecasts.append((log_weights, positions))
    (log_weights, here), (others, there) = forecasts
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[cos, -sin], [sin, cos]])
    torch.testing.assert_close(others, log_weights, atol=1e-3, rtol=0)
    torch.testing.assert_close(there.mean, here.mean @ turn.T, atol=2e-3, rtol=0)
    torch.testing.assert_close(there.covariance, turn @ here.covariance @ turn.T, atol=1e-2, rtol=1e-3)


def test_blind_is_what_a_call_without_map_and_neighbours_is_told(network: AgentFrameNetwork) -> None:
    features = features_in_agent_frame(6)
    alone = features | {name: torch.zeros_like(features[name]) for name in ("map", "far_map", "neighbors")}
    with torch.no_grad():
        blind = network(features, Context.BLIND, STEPS)
        full = network(alone, Context.FULL, STEPS)
    # What is read along the path differs: a null context reads nothing, an unknown map reads zeros
    torch.testing.assert_close(blind[0], full[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(blind[1].mean, full[1].mean, atol=1e-4, rtol=0)


def test_no_direction_is_narrower_than_the_floor_whatever_the_calibration(network: AgentFrameNetwork) -> None:
    features = features_in_agent_frame(8)
    with torch.no_grad():
        network.sigma.bias.fill_(-50.0)
        network.width.fill_(0.01)
        _, positions = network(features, Context.FULL, STEPS)
    narrow = torch.linalg.eigvalsh(positions.covariance.double())[..., 0].sqrt()
    assert narrow[:, :, 1].min() >= 0.1 - 1e-4
    assert narrow[:, :, 11].min() >= 0.3 - 1e-4
    assert narrow.max() < 0.5


@pytest.mark.parametrize(("speed", "ahead"), [(8.0, 8.0 * 6), (-2.0, -2.0 * 6), (0.0, 0.0)])
def test_without_controls_speed_is_kept_along_the_heading(speed: float, ahead: float) -> None:
    path = drive(torch.zeros(1, 1, STEPS, 2), torch.zeros(1, 1), torch.tensor([[speed]]))
    assert path.x[0, 0, -1].item() == pytest.approx(ahead, abs=1e-5)
    assert path.y.abs().max().item() == 0


def test_a_steady_turn_is_a_circle_to_centimetres() -> None:
    rate, speed = 0.2, 10.0
    controls = torch.tensor([rate, 0.0]).expand(1, 1, STEPS, 2)
    path = drive(controls, torch.zeros(1, 1), torch.tensor([[speed]]))
    seconds = 0.5 * torch.arange(1, STEPS + 1)
    radius = speed / rate
    assert (path.x[0, 0] - radius * torch.sin(rate * seconds)).abs().max() < 0.05
    assert (path.y[0, 0] - radius * (1 - torch.cos(rate * seconds))).abs().max() < 0.05


def test_a_steady_braking_is_a_parabola() -> None:
    controls = torch.tensor([0.0, -1.0]).expand(1, 1, STEPS, 2)
    path = drive(controls, torch.zeros(1, 1), torch.tensor([[9.0]]))
    seconds = 0.5 * torch.arange(1, STEPS + 1)
    torch.testing.assert_close(path.x[0, 0], 9 * seconds - seconds.square() / 2, atol=1e-4, rtol=0)


def test_who_brakes_stops_and_who_reverses_goes_on() -> None:
    controls = torch.tensor([0.0, -2.0]).expand(1, 2, STEPS, 2)
    path = drive(controls, torch.zeros(1, 2), torch.tensor([[5.0, 0.5]]))
    assert path.speed[0, 0, 5:].abs().max().item() == 0
    assert path.x[0, 0, -1].item() == pytest.approx(5**2 / (2 * 2), abs=0.15)
    assert path.x[0, 0].diff().min().item() == 0
    assert path.speed[0, 1, -1].item() == pytest.approx(0.5 - 2 * 6, abs=1e-4)  # it stands: it may back out


@pytest.mark.parametrize("geometry", [NEAR, FAR])
def test_a_patch_is_read_where_its_pixels_lie(geometry: PatchGeometry) -> None:
    patch = torch.zeros(1, 3, 100, 100)
    patch[0, 1, 40, 70] = 1.0
    x = torch.tensor([[(40 - geometry.rows_behind) / geometry.pixels_per_meter]])
    y = torch.tensor([[(70 - geometry.columns_right) / geometry.pixels_per_meter]])
    np.testing.assert_allclose(read_patch(patch, x, y, geometry)[0, :, 0], [0, 1, 0], atol=1e-4)
    beyond = read_patch(torch.ones(1, 3, 100, 100), torch.tensor([[80.0]]), torch.tensor([[0.0]]), geometry)
    assert beyond.abs().max().item() == 0  # unknown


def test_the_far_patch_shows_nothing_beyond_what_recorded_rasters_hold() -> None:
    corner = math.hypot(
        (FAR.size - FAR.rows_behind) / FAR.pixels_per_meter, FAR.columns_right / FAR.pixels_per_meter
    )
    assert 70 < corner < 74


def test_more_steps_than_are_decoded_are_refused(network: AgentFrameNetwork) -> None:
    with pytest.raises(ValueError, match="12 steps, not 13"):
        network(features_in_agent_frame(1), Context.FULL, 13)


def test_a_checkpoint_of_it_forecasts_the_same(network: AgentFrameNetwork, tmp_path: Path) -> None:
    info = cab_network(Frame.AGENT).info
    networks = CvaeNetworks(CONFIG)
    networks.of(AgentType.VEHICLE).load_state_dict(network.state_dict())
    folder = tmp_path / "checkpoint"
    save_checkpoint(folder, info, CONFIG, networks.state_dict(), "card")
    loaded = load_checkpoint(folder).forecaster()
    assert isinstance(loaded, CvaeForecaster)
    features = features_in_agent_frame(3)
    with torch.no_grad():
        expected = network(features, Context.FULL, STEPS)[1].mean
    torch.testing.assert_close(loaded.forecast(features, AgentType.VEHICLE).means, expected)


def test_it_exports_to_a_graph_that_says_the_same(network: AgentFrameNetwork) -> None:
    class Forward(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, features: Features) -> tuple[Tensor, Tensor, Tensor]:
            log_weights, positions = self.network(features, Context.FULL, STEPS)
            return log_weights, positions.mean, positions.covariance

    batch = {name: dict.fromkeys([0], torch.export.Dim.AUTO) for name in features_in_agent_frame(4)}
    exported = torch.export.export(
        Forward().eval(), (features_in_agent_frame(4),), dynamic_shapes={"features": batch}
    )
    features = features_in_agent_frame(7)
    with torch.no_grad():
        for one, other in zip(Forward().eval()(features), exported.module()(features), strict=True):
            torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)


def test_a_map_far_ahead_matters_and_one_without_far_map_has_no_encoder_for_it(
    network: AgentFrameNetwork,
) -> None:
    features = features_in_agent_frame(2)
    with torch.no_grad():
        one: Modes = network.decode(network.encode(features, Context.FULL), features, Context.FULL)
        other_map = features | {"far_map": -features["far_map"]}
        other = network.decode(network.encode(other_map, Context.FULL), other_map, Context.FULL)
    assert (one.path.x - other.path.x).abs().max() > 1e-3
    near_only = AgentFrameNetwork(NetworkConfig(frame=Frame.AGENT))
    assert not any("far_map" in name for name in near_only.state_dict())


def test_an_own_blind_branch_sees_the_history_alone() -> None:
    torch.manual_seed(0)
    network = AgentFrameNetwork(CONFIG.model_copy(update={"blind": BlindContext.OWN})).eval()
    features = features_in_agent_frame(4)
    alone = {name: features[name] for name in ("origin", "heading", "speed", "history", "first")}
    with torch.no_grad():
        full, _ = network(features, Context.FULL, STEPS)
        weights, positions = network(alone, Context.BLIND, STEPS)
        assert network.blind_network is not None
        expected, places = network.blind_network(alone, Context.FULL, STEPS)
    assert torch.equal(weights, expected)
    assert torch.equal(positions.mean, places.mean)
    assert (full - weights).abs().max() > 1e-3
