import torch

from loadtest.forward import features
from model.evaluation.ablation import Without, ablations, without_both, without_map, without_neighbors
from model.forecaster import Context, Features
from model.networks.config import NetworkConfig
from model.networks.forecaster import CvaeForecaster
from model.scenes.scene import AgentType
from tests.model.checkpoints import info, tensors
from tests.model.evaluation.builders import ALONE, FULL

NEIGHBORS = {"neighbors.vehicle", "neighbors.pedestrian", "edge_mask"}


def model() -> CvaeForecaster:
    return CvaeForecaster(info(FULL), FULL, tensors(FULL))


def changed(before: Features, after: Features) -> set[str]:
    assert before.keys() == after.keys()
    return {name for name in before if not torch.equal(before[name], after[name])}


def test_only_what_is_taken_away_changes_and_becomes_zero() -> None:
    given = features(4)
    untouched = {name: tensor.clone() for name, tensor in given.items()}
    for take_away, names in (
        (without_map, {"map"}),
        (without_neighbors, NEIGHBORS),
        (without_both, {"map"} | NEIGHBORS),
    ):
        less = take_away(given)
        assert changed(given, less) == names
        assert all(not less[name].any() for name in names)
    assert not changed(untouched, given)


def test_without_both_cab_forecasts_as_when_blind() -> None:
    given, cab = features(4), model()
    ablated = cab.forecast(without_both(given), AgentType.VEHICLE)
    blind = cab.forecast(given, AgentType.VEHICLE, Context.BLIND)
    torch.testing.assert_close(ablated.means, blind.means)
    torch.testing.assert_close(ablated.weights, blind.weights)
    assert not torch.allclose(ablated.means, cab.forecast(given, AgentType.VEHICLE).means)


def test_nothing_is_taken_away_that_is_not_looked_at() -> None:
    assert set(ablations(info(FULL))) == set(Without)
    assert set(ablations(info(NetworkConfig(neighbor_types=())))) == {Without.MAP}
    assert set(ablations(info(NetworkConfig(uses_map=False)))) == {Without.NEIGHBORS}
    assert not ablations(info(ALONE))
