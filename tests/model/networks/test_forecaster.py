"""The CVAE forecaster: what must change a forecast does, and what must not does not."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from loadtest.forward import cab_network
from model.arrays import Ints
from model.forecaster import Context, ModelInfo, join
from model.networks.config import BlindContext, NetworkConfig
from model.networks.forecaster import MIN_VARIANCE, CvaeForecaster, CvaeNetworks, network_mixture
from model.scenes.resample import resample
from model.scenes.scene import AgentType, Raster, Scene
from tests.model.builders import observations

NOW = 1_700_000_000.0
TYPES = [AgentType.VEHICLE] * 6 + [AgentType.PEDESTRIAN] * 2 + [AgentType.CYCLIST]
VEHICLES: Ints = np.arange(6)


@pytest.fixture(scope="module")
def model() -> CvaeForecaster:
    return cab_network()


def scene(shift: float = 0.0, seed: int = 0) -> Scene:
    """Nine agents within reach of each other, one of them newly seen, on a random map."""
    rng = np.random.default_rng(seed)
    tracks = []
    for n in range(len(TYPES)):
        times = NOW - np.arange(6 if n != 2 else 1, -1, -1) * 0.5
        velocity = rng.uniform(-8, 8, 2)
        path = rng.uniform(-12, 12, 2) + shift + (times - NOW)[:, None] * velocity
        heading = np.full(len(times), np.arctan2(velocity[1], velocity[0]))
        tracks.append(
            {"time": times, "position": path + 0.05 * rng.normal(size=path.shape), "heading": heading}
        )
    raster = Raster(
        layers=rng.integers(0, 2, (3, 240, 240), dtype=np.uint8),
        origin=np.array([-40.0, -40.0]) + shift,
        pixels_per_meter=3.0,
    )
    return Scene(TYPES, resample(observations(tracks), NOW, 5), raster)


@pytest.mark.parametrize("context", list(Context))
def test_shapes_and_sanity(model: CvaeForecaster, context: Context) -> None:
    mixture = model(scene(), VEHICLES, context)
    assert mixture.means.shape == (6, 25, 12, 2)
    assert mixture.covariances.shape == (6, 25, 12, 2, 2)
    assert mixture.origin.dtype == torch.float64
    torch.testing.assert_close(mixture.weights.sum(1), torch.ones(6))
    assert (torch.linalg.eigvalsh(mixture.covariances.double()) > 0).all()
    assert model(scene(), VEHICLES, context, steps=4).means.shape == (6, 25, 4, 2)


def test_the_minimum_variance_is_added_where_it_is_asked_for(model: CvaeForecaster) -> None:
    network, features = model.networks.of(AgentType.VEHICLE), model.prepare(scene(), VEHICLES)
    plain = network_mixture(network, features, Context.FULL, 12)
    served = model.forecast(features, AgentType.VEHICLE)
    torch.testing.assert_close(served.means, plain.means)
    torch.testing.assert_close(served.log_weights, plain.log_weights)
    trace = plain.covariances.diagonal(dim1=-2, dim2=-1).sum(-1)
    added = (MIN_VARIANCE + 1e-6 * trace)[..., None, None] * torch.eye(2)
    torch.testing.assert_close(served.covariances, plain.covariances + added, rtol=0, atol=0)
    assert not torch.equal(served.covariances, plain.covariances)
    flat = network_mixture(network, features, Context.FULL, 12, min_variance=1.0)
    assert (torch.linalg.eigvalsh(flat.covariances.double()) >= 1.0 - 1e-4).all()


@pytest.mark.parametrize("context", list(Context))
def test_the_first_steps_do_not_hang_on_the_horizon(model: CvaeForecaster, context: Context) -> None:
    long, short = model(scene(), VEHICLES, context), model(scene(), VEHICLES, context, steps=5)
    torch.testing.assert_close(long.means[:, :, :5], short.means, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("context", list(Context))
def test_where_the_origin_is_does_not_matter(model: CvaeForecaster, context: Context) -> None:
    shift = 100_000.0
    near, far = model(scene(), VEHICLES, context), model(scene(shift), VEHICLES, context)
    torch.testing.assert_close(near.weights, far.weights, rtol=0, atol=1e-5)
    torch.testing.assert_close(near.world_means + shift, far.world_means, rtol=0, atol=1e-3)
    torch.testing.assert_close(near.covariances, far.covariances, rtol=1e-3, atol=1e-5)


def test_an_agents_forecast_does_not_hang_on_who_else_is_in_the_batch(model: CvaeForecaster) -> None:
    one, other = scene(), scene(seed=1)
    parts = [model.prepare(s, VEHICLES) for s in (one, other)]
    together = model.forecast(join(parts), AgentType.VEHICLE)
    for n, s in enumerate((one, other)):
        alone = model(s, VEHICLES)
        torch.testing.assert_close(together[6 * n : 6 * n + 6].means, alone.means, rtol=1e-4, atol=1e-4)
    single = model(one, VEHICLES[2:3])
    torch.testing.assert_close(single.means, model(one, VEHICLES)[2:3].means, rtol=1e-4, atol=1e-4)


def test_the_order_of_agents_does_not_matter(model: CvaeForecaster) -> None:
    plain, order = scene(), np.random.default_rng(5).permutation(len(TYPES))
    s = plain.states
    shuffled = Scene(
        [TYPES[i] for i in order],
        replace(s, **{name: getattr(s, name)[order] for name in s.__dataclass_fields__}),
        plain.raster,
    )
    at = np.array([int(np.flatnonzero(order == v)[0]) for v in VEHICLES])
    torch.testing.assert_close(model(plain, VEHICLES).means, model(shuffled, at).means, rtol=1e-4, atol=1e-4)


def test_full_forecasts_see_map_and_neighbours_blind_ones_do_not(model: CvaeForecaster) -> None:
    base = scene()
    without_map = replace(base, raster=None)
    alone = replace(base, types=[*TYPES[:1], *[AgentType.CYCLIST] * 8])
    blind = model(base, VEHICLES[:1], Context.BLIND)
    full = model(base, VEHICLES[:1])
    for changed in (without_map, alone):
        assert (model(changed, VEHICLES[:1]).means - full.means).abs().max() > 1e-3
        torch.testing.assert_close(model(changed, VEHICLES[:1], Context.BLIND).means, blind.means)


def test_an_own_patch_goes_before_the_raster(model: CvaeForecaster) -> None:
    base = scene()
    patch = np.zeros((3, 100, 100), dtype=np.uint8)
    patched = replace(base, patches={1: patch})
    a, b = model(base, VEHICLES), model(patched, VEHICLES)
    assert (a.means[1] - b.means[1]).abs().max() > 1e-3
    torch.testing.assert_close(a.means[0], b.means[0], rtol=1e-4, atol=1e-4)
    features = model.prepare(patched, VEHICLES)
    assert (features["map"][1] == -1).all()


def test_an_unknown_map_is_midway(model: CvaeForecaster) -> None:
    features = model.prepare(replace(scene(), raster=None), VEHICLES)
    assert not features["map"].any()


def test_a_neighbour_without_heading_is_no_fault(model: CvaeForecaster) -> None:
    base = scene()
    base.states.heading[3] = np.nan
    mixture = model(base, VEHICLES[:3])
    assert mixture.means.isfinite().all()


def test_a_vehicle_without_heading_is_refused(model: CvaeForecaster) -> None:
    base = scene()
    base.states.heading[3, -1] = np.nan
    assert model.requires_heading(AgentType.VEHICLE)
    with pytest.raises(ValueError, match="no heading"):
        model(base, VEHICLES)


def test_headings_across_half_a_turn_are_no_jump(model: CvaeForecaster) -> None:
    """Driving along −x, headings a hair to either side of π are the same history."""
    mixtures = []
    for signs in ([1, 1, 1, 1, 1], [-1, 1, -1, 1, 1]):
        base = scene()
        base.states.heading[0] = np.array(signs) * (np.pi - 1e-4)
        mixtures.append(model(base, VEHICLES[:1]))
    torch.testing.assert_close(mixtures[0].means, mixtures[1].means, rtol=0, atol=0.01)


def test_wrong_tensors_are_named() -> None:
    config = NetworkConfig(blind=BlindContext.NULL)
    info: ModelInfo = cab_network().info
    tensors = dict(CvaeNetworks(config).state_dict())
    kept = "vehicle.full.decoder.mean.weight"
    with pytest.raises(ValueError, match=f"{kept} is missing"):
        CvaeForecaster(info, config, {k: v for k, v in tensors.items() if k != kept})
    with pytest.raises(ValueError, match="surplus is not of this network"):
        CvaeForecaster(info, config, tensors | {"surplus": torch.zeros(1)})
    with pytest.raises(ValueError, match=r"mean.weight is \[3\], not \[2, 128\]"):
        CvaeForecaster(info, config, tensors | {kept: torch.zeros(3)})
    with pytest.raises(ValueError, match="float64, not float32"):
        CvaeForecaster(info, config, tensors | {kept: tensors[kept].double()})


def test_a_network_without_a_blind_forecast_refuses() -> None:
    config = NetworkConfig()
    model = CvaeForecaster(cab_network().info, config, CvaeNetworks(config).state_dict())
    with pytest.raises(ValueError, match="no blind forecast"):
        model(scene(), VEHICLES, Context.BLIND)


def test_every_shape_of_network_runs() -> None:
    both = (AgentType.VEHICLE, AgentType.PEDESTRIAN)
    for neighbors in ((), both):
        for uses_map in (False, True):
            for blind in BlindContext:
                config = NetworkConfig(
                    agent_types=both, neighbor_types=neighbors, uses_map=uses_map, blind=blind, modes=7
                )
                model = CvaeForecaster(cab_network().info, config, CvaeNetworks(config).state_dict())
                for targets in (VEHICLES, np.array([6, 7])):
                    for context in Context:
                        if context is Context.FULL or blind is not BlindContext.NONE:
                            assert model(scene(), targets, context).means.isfinite().all()
