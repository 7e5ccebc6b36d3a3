"""CoverNet: its forecasts, as network, forecaster and checkpoint."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from model.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from model.features.spec import Frame
from model.forecaster import Context, join
from model.geometry import rotate, wrap_angle
from model.networks.config import CoverNetConfig
from model.networks.covernet import CoverNet, boxes
from model.networks.forecaster import CoverNetForecaster, CoverNetworks
from model.networks.rasterize_boxes import rasterize_boxes
from model.registry import Registry
from model.scenes.scene import AgentType, Scene
from tests.model.checkpoints import info
from tests.model.networks.test_forecaster import TYPES, VEHICLES, scene

MEMBERS = 40
CONFIG = CoverNetConfig(members=MEMBERS)


def tensors(config: CoverNetConfig = CONFIG) -> dict[str, Tensor]:
    """Random parameters, and a cover of paths that go ahead."""
    torch.manual_seed(0)
    networks = CoverNetworks(config)
    network = networks.of(AgentType.VEHICLE)
    speeds, drift = torch.rand(config.members, 1) * 5, torch.randn(config.members, 1)
    ahead = torch.arange(1.0, config.steps + 1)
    network.trajectory_set.copy_(torch.stack([speeds * ahead, 0.1 * drift * ahead], dim=-1))
    network.variance.copy_(torch.stack([0.5 * ahead, 0.1 * ahead], dim=-1))
    return dict(networks.state_dict())


@pytest.fixture(scope="module")
def model() -> CoverNetForecaster:
    return CoverNetForecaster(info(CONFIG), CONFIG, tensors())


def test_a_forecast_is_of_the_likeliest_members(model: CoverNetForecaster) -> None:
    features = model.prepare(scene(), VEHICLES)
    mixture = model.forecast(features, AgentType.VEHICLE)
    network = model.networks.of(AgentType.VEHICLE)
    assert mixture.means.shape == (6, 25, 12, 2)
    torch.testing.assert_close(mixture.weights.sum(1), torch.ones(6))
    scores = network.scores(features)
    headings = scene().states.heading[VEHICLES, -1]
    for row in range(6):
        order = scores[row].argsort(descending=True)[:25]
        torch.testing.assert_close(mixture.log_weights[row], torch.log_softmax(scores[row, order], dim=0))
        wanted = rotate(network.trajectory_set[order].double().numpy(), headings[row])
        np.testing.assert_allclose(mixture.means[row].numpy(), wanted, atol=1e-4)
    assert (mixture.most_likely() == 0).all()
    short = model.forecast(features, AgentType.VEHICLE, steps=3)
    torch.testing.assert_close(short.means, mixture.means[:, :, :3])
    torch.testing.assert_close(short.covariances, mixture.covariances[:, :, :3])


def test_the_spread_lies_along_the_heading(model: CoverNetForecaster) -> None:
    base = scene()
    base.states.heading[0, -1] = np.pi / 2
    base.states.heading[1, -1] = 0.0
    covariances = model(base, VEHICLES[:2]).covariances
    ahead = torch.arange(1.0, 13)
    for row, (x, y) in enumerate(((0.1, 0.5), (0.5, 0.1))):
        for mode in (0, 24):
            spread = covariances[row, mode]
            torch.testing.assert_close(spread[:, 0, 0], x * ahead, rtol=1e-4, atol=1e-4)
            torch.testing.assert_close(spread[:, 1, 1], y * ahead, rtol=1e-4, atol=1e-4)
            torch.testing.assert_close(spread[:, 0, 1], torch.zeros(12), rtol=0, atol=1e-4)


def test_forecasts_turn_with_the_scene(model: CoverNetForecaster) -> None:
    base, angle = replace(scene(), raster=None), 2.0
    s = base.states
    turn = np.array(angle)
    states = replace(
        s,
        position=rotate(s.position, turn),
        velocity=rotate(s.velocity, turn),
        acceleration=rotate(s.acceleration, turn),
        heading=wrap_angle(s.heading + angle),
    )
    other = replace(base, states=states)
    plain, moved = model(base, VEHICLES), model(other, VEHICLES)
    torch.testing.assert_close(moved.weights, plain.weights, rtol=1e-3, atol=1e-5)
    wanted = rotate(plain.means.double().numpy(), np.array(angle))
    np.testing.assert_allclose(moved.means.numpy(), wanted, atol=1e-3)


def test_it_sees_map_neighbours_and_its_own_motion(model: CoverNetForecaster) -> None:
    base = scene()
    network = model.networks.of(AgentType.VEHICLE)

    def scores(one: Scene) -> Tensor:
        return network.scores(model.prepare(one, VEHICLES[:1]))

    plain = scores(base)
    faster = replace(base, states=replace(base.states, velocity=2 * base.states.velocity))
    alone = replace(base, types=[*TYPES[:1], *[AgentType.CYCLIST] * 8])
    around = model.prepare(base, VEHICLES)["neighbor_boxes"][..., 3] > 0
    assert around.any()
    for changed in (replace(base, raster=None), faster):
        assert (scores(changed) - plain).abs().max() > 1e-4
    assert not (model.prepare(alone, VEHICLES[:1])["neighbor_boxes"]).any()
    seen = VEHICLES[around.any(dim=1).numpy()][:1]
    boxes = model.prepare(base, seen)
    empty = boxes | {"neighbor_boxes": torch.zeros_like(boxes["neighbor_boxes"])}
    assert (network.scores(boxes) - network.scores(empty)).abs().max() > 1e-5


def test_in_the_agents_frame_it_sees_the_far_map_and_the_same_boxes() -> None:
    config = CoverNetConfig(members=MEMBERS, frame=Frame.AGENT, far_map=True)
    model = CoverNetForecaster(info(config), config, tensors(config))
    assert model.looks_at_far_map(AgentType.VEHICLE)
    base = scene()
    features = model.prepare(base, VEHICLES)
    network = model.networks.of(AgentType.VEHICLE)
    plain = network.scores(features)
    for name in ("far_map", "map", "neighbors"):
        without = features | {name: torch.zeros_like(features[name])}
        assert (network.scores(without) - plain).abs().max() > 1e-5, name
    # The same agents as boxes of the ground frame's features
    drawn = CoverNetForecaster(info(CONFIG), CONFIG, tensors()).prepare(base, VEHICLES)
    torch.testing.assert_close(
        rasterize_boxes(boxes(features)), rasterize_boxes(boxes(drawn)), atol=1e-4, rtol=1e-4
    )
    headings = base.states.heading[VEHICLES, -1]
    likeliest = network.trajectory_set[plain.argmax(dim=1)].double().numpy()
    np.testing.assert_allclose(
        model(base, VEHICLES).means[:, 0].numpy(), rotate(likeliest, headings[:, None]), atol=1e-3
    )


def test_agents_of_many_scenes_share_a_forward(model: CoverNetForecaster) -> None:
    one, other = scene(), scene(seed=1)
    together = model.forecast(join([model.prepare(s, VEHICLES) for s in (one, other)]), AgentType.VEHICLE)
    for n, s in enumerate((one, other)):
        alone = model(s, VEHICLES)
        torch.testing.assert_close(together[6 * n : 6 * n + 6].weights, alone.weights, rtol=1e-3, atol=1e-5)


def test_what_it_cannot_do_is_refused(model: CoverNetForecaster) -> None:
    base = scene()
    with pytest.raises(ValueError, match="no blind forecast"):
        model(base, VEHICLES, Context.BLIND)
    with pytest.raises(ValueError, match="12 steps, not 13"):
        model(base, VEHICLES, steps=13)
    assert model.requires_heading(AgentType.VEHICLE)
    base.states.heading[3, -1] = np.nan
    with pytest.raises(ValueError, match="no heading"):
        model(base, VEHICLES)
    with pytest.raises(ValueError, match="members is 0"):
        CoverNet(CoverNetConfig())


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"members": 7}, "25 modes cannot be of 7 members"),
        ({"uses_map": False, "neighbor_types": ()}, "nothing in the picture"),
        ({"neighbor_types": ("cyclist",)}, "cyclist are not drawn"),
        ({"agent_types": ("pedestrian",)}, "agent_types"),
    ],
)
def test_shapes_that_make_no_sense(change: dict[str, object], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        CoverNetConfig.model_validate({"members": MEMBERS} | change)


@pytest.mark.parametrize("change", [{"uses_map": False}, {"neighbor_types": ()}])
def test_networks_that_see_less(change: dict[str, object]) -> None:
    config = CoverNetConfig.model_validate({"members": MEMBERS} | change)
    model = CoverNetForecaster(info(config), config, tensors(config))
    assert model(scene(), VEHICLES).means.isfinite().all()


def test_the_registry_serves_its_checkpoint(tmp_path: Path) -> None:
    save_checkpoint(tmp_path / "covernet", info(CONFIG, name="covernet"), CONFIG, tensors(), "")
    forecaster = Registry.load(tmp_path).get("covernet")
    assert isinstance(forecaster, CoverNetForecaster)
    assert not forecaster.info.supports_blind
    assert forecaster(scene(), VEHICLES).means.isfinite().all()


def test_a_checkpoint_whose_set_or_horizon_is_another(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, info(CONFIG), CoverNetConfig(members=MEMBERS + 1), tensors(), "")
    with pytest.raises(CheckpointError, match=r"vehicle\.cover is \[40, 12, 2\], not \[41, 12, 2\]"):
        load_checkpoint(tmp_path).forecaster()
    with pytest.raises(ValueError, match="does not fit the network in steps"):
        save_checkpoint(tmp_path, info(CONFIG).model_copy(update={"steps": 24}), CONFIG, tensors(), "")
