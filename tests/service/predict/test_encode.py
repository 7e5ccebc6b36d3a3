"""Responses of a plan, and forecasts that leave the road."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.forecaster import Context, Prepared
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentType, Raster
from service.errors import Fault
from service.predict.batcher import Job, Outcome
from service.predict.encode import agent_seed, count_off_road, encode
from service.predict.plan import Draft, Group, Plan
from service.predict.request import read_agents, read_options
from service.settings import Settings
from tests.service.fakes import FakeForecaster
from tests.service.requests import make_request


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
    return Group(Job(forecaster, AgentType.VEHICLE, Context.FULL, Prepared({}), 12), drafts, outcome)


def raster() -> Raster:
    """Road from 10 m behind to 10 m ahead of where the agents are."""
    layers = np.zeros((3, 60, 60), dtype=np.uint8)
    layers[0] = 1
    return Raster(layers=layers, origin=np.array([990.0, 1990.0]), pixels_per_meter=3.0)


def plan_of(groups: list[Group], **options: Any) -> Plan:
    """Return a plan whose groups have run; its drafts are those of the groups in the order of their index."""
    request = make_request(3, **options)
    forecaster = groups[0].job.forecaster
    drafts = sorted((draft for group in groups for draft in group.drafts), key=lambda draft: draft.index)
    return Plan(
        options=read_options(request, forecaster.info, Settings()),
        agents=read_agents(request, Settings()),
        forecaster=forecaster,
        fallback=forecaster,
        scene=None,
        drafts=drafts,
        warnings=["a warning"],
        input_warnings={},
        groups=groups,
    )


def test_forecasts_are_in_the_order_of_the_request() -> None:
    first, second = result([1.0, 2.0]), result([3.0])
    first.drafts[0].index, first.drafts[1].index, second.drafts[0].index = 0, 2, 1
    second.drafts[0].agent_id = "between"
    response = encode(plan_of([first, second]), seed=0)
    assert [forecast.agent_id for forecast in response.forecasts] == ["0", "between", "1"]
    ends = [forecast.means[2 * 12 - 2] - 1000 for forecast in response.forecasts]
    assert ends == pytest.approx([1.0, 3.0, 2.0])
    assert (response.model.name, response.steps, response.step) == ("fake", 12, 0.5)
    assert list(response.warnings) == ["a warning"]


def test_timing_is_of_all_batches_and_counts_what_runs_at_the_same_time_once() -> None:
    first, second = result([1.0, 2.0]), result([3.0])
    assert first.outcome is not None
    assert second.outcome is not None
    first.outcome = replace(first.outcome, queue=0.3, inference=0.25, batch_agents=5)
    second.outcome = replace(second.outcome, queue=0.2, inference=0.25, batch_agents=2)
    timing = encode(plan_of([first, second]), seed=0).timing
    assert (timing.queue, timing.batch_agents) == (0.2, 5)
    assert timing.inference == pytest.approx(0.35)


def test_an_invalid_agent_has_its_fault_and_no_numbers() -> None:
    group = result([1.0])
    plan = plan_of([group])
    invalid = Draft(1, "bad", pb.FORECAST_STATUS_OK)
    invalid.invalidate(Fault("agents[1].x", "is required"))
    plan.drafts.append(invalid)
    good, bad = encode(plan, seed=0).forecasts
    assert len(good.weights) == 3
    assert (bad.status, bad.field, bad.detail) == (pb.FORECAST_STATUS_INVALID, "agents[1].x", "is required")
    assert not bad.HasField("model")
    assert not bad.weights
    assert not bad.means


def test_a_group_whose_forecasts_were_all_replaced_is_left_out() -> None:
    lost, replaced = result([1.0]), result([2.0])
    lost.drafts = []
    assert lost.outcome is not None
    lost.outcome = replace(lost.outcome, mixture=lost.outcome.mixture[:0])
    [forecast] = encode(plan_of([lost, replaced], samples=2), seed=1).forecasts
    assert forecast.means[2 * 12 - 2] - 1000 == pytest.approx(2.0)
    assert count_off_road(raster(), [lost]) == {}


@pytest.mark.parametrize("heaviest", [0, 1, 2])
def test_the_heaviest_modes_are_kept_in_the_models_order(heaviest: int) -> None:
    [forecast] = encode(plan_of([result([6.0], heaviest)], max_modes=2), seed=0).forecasts
    others = [mode for mode in range(3) if mode != heaviest]
    assert list(forecast.mode_ids) == sorted([heaviest, others[0]])
    assert forecast.most_likely_mode == list(forecast.mode_ids).index(heaviest)
    assert list(forecast.weights)[forecast.most_likely_mode] == pytest.approx(0.8)
    assert forecast.remaining_weight == pytest.approx(0.1)
    assert len(forecast.means) == 2 * 12 * 2
    assert list(forecast.covariances) == [1.0, 0.0, 1.0] * 24


def test_samples_follow_seed_and_id() -> None:
    def samples(seed: int, agent_id: str) -> list[float]:
        group = result([6.0])
        group.drafts[0].agent_id = agent_id
        [forecast] = encode(plan_of([group], samples=3), seed=seed).forecasts
        return list(forecast.samples)

    first = samples(1, "a")
    assert len(first) == 3 * 12 * 2
    assert samples(1, "a") == first
    assert samples(2, "a") != first
    assert samples(1, "b") != first


def test_seeds_of_agents_are_fixed() -> None:
    """Clients draw the same samples again with the seed of an old response."""
    assert agent_seed(0, "a") == 45856654970949906
    assert agent_seed(2**32 - 1, "Ω-7") == 8586774705170639510


def test_the_likeliest_path_decides() -> None:
    for heaviest in range(3):
        counts = count_off_road(
            raster(), [result([5.0, 30.0, 9.0, -30.0], heaviest), result([50.0], heaviest)]
        )
        assert counts == {"fake": 3}


def test_without_a_map_nothing_is_known() -> None:
    assert not count_off_road(None, [result([30.0])])
