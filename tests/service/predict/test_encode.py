"""Responses of a plan, and forecasts that leave the road."""

import numpy as np
import torch

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.forecaster import Context
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentType, Raster
from service.predict.batcher import Job, Outcome
from service.predict.encode import count_off_road
from service.predict.plan import Draft, Group
from tests.service.fakes import FakeForecaster


def result(ends: list[float], heaviest: int = 0) -> Group:
    """Agents that go along x to their ends in the heaviest of three modes, and nowhere in the others."""
    means = torch.zeros(len(ends), 3, 12, 2)
    means[:, heaviest, :, 0] = torch.tensor(ends)[:, None] * torch.linspace(1 / 12, 1, 12)
    weights = torch.full((len(ends), 3), 0.1)
    weights[:, heaviest] = 0.8
    forecaster = FakeForecaster()
    drafts = [Draft(n, str(n), pb.FORECAST_STATUS_OK, row=n, forecaster=forecaster) for n in range(len(ends))]
    origin = torch.tensor([1000.0, 2000.0], dtype=torch.float64).expand(len(ends), 2)
    covariances = torch.eye(2).expand(len(ends), 3, 12, 2, 2)
    outcome = Outcome(TrajectoryMixture(weights.log(), means, covariances, origin), 0.0, 0.0, len(ends))
    return Group(Job(forecaster, AgentType.VEHICLE, Context.FULL, {}, 12), drafts, outcome)


def raster() -> Raster:
    """Road from 10 m behind to 10 m ahead of where the agents are."""
    layers = np.zeros((3, 60, 60), dtype=np.uint8)
    layers[0] = 1
    return Raster(layers=layers, origin=np.array([990.0, 1990.0]), pixels_per_meter=3.0)


def test_the_likeliest_path_decides() -> None:
    for heaviest in range(3):
        counts = count_off_road(
            raster(), [result([5.0, 30.0, 9.0, -30.0], heaviest), result([50.0], heaviest)]
        )
        assert counts == {"fake": 3}


def test_without_a_map_nothing_is_known() -> None:
    assert not count_off_road(None, [result([30.0])])
