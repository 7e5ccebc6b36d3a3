"""Plans: the forecaster of each agent, the groups that share a forward, and forecasts that are not finite."""

import pytest
import torch

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.forecaster import Context
from model.mixture import TrajectoryMixture
from model.scenes.scene import AgentType
from service.errors import BadFields
from service.predict.batcher import Outcome
from service.predict.catalog import build_catalog
from service.predict.forward import finite
from service.predict.plan import Group, Plan, frames_of, make_plan, set_outcomes
from service.predict.request import read_agents, read_options
from service.settings import FALLBACK_MODEL, Settings
from tests.service.fakes import FakeForecaster, registry
from tests.service.requests import CYCLIST, PEDESTRIAN, add_agent, make_request

SETTINGS = Settings()
OK, FALLBACK, INVALID = pb.FORECAST_STATUS_OK, pb.FORECAST_STATUS_FALLBACK, pb.FORECAST_STATUS_INVALID


def plan_of(request: pb.PredictRequest, fake: FakeForecaster) -> Plan:
    catalog = build_catalog(registry(fake), fake.info.name)
    options = read_options(request, fake.info, SETTINGS)
    return make_plan(request, options, fake, catalog, SETTINGS)


def outcome(group: Group, broken: tuple[int, ...] = ()) -> Outcome:
    """Return the outcome of a group, in which the forecasts of some rows are NaN."""
    job = group.job
    mixture = job.forecaster.forecast(job.inputs.features, job.agent_type, job.context, job.steps)
    mixture.means[list(broken)] = torch.nan
    return Outcome(mixture, 0.1, 0.2, len(mixture))


def test_one_group_per_forecaster_and_type() -> None:
    request = make_request(2)
    add_agent(request, "walker", PEDESTRIAN, y=20)
    add_agent(request, "bike", CYCLIST, y=30)
    add_agent(request, "a2", y=40)
    plan = plan_of(request, FakeForecaster())
    assert [
        (group.job.forecaster.info.name, group.job.agent_type, [draft.agent_id for draft in group.drafts])
        for group in plan.groups
    ] == [
        ("fake", AgentType.VEHICLE, ["a0", "a1", "a2"]),
        ("fake", AgentType.PEDESTRIAN, ["walker"]),
        (FALLBACK_MODEL, AgentType.CYCLIST, ["bike"]),
    ]
    assert [group.job.agents for group in plan.groups] == [3, 1, 1]
    assert [draft.status for draft in plan.drafts] == [OK, OK, OK, FALLBACK, OK]
    assert [draft.row for draft in plan.drafts] == [0, 1, 2, 3, 4]


def test_rows_are_those_of_the_usable_agents() -> None:
    request = make_request(4)
    request.agents[0].ClearField("type")
    request.agents[2].predict = False
    plan = plan_of(request, FakeForecaster())
    assert [(draft.agent_id, draft.index, draft.row) for draft in plan.drafts] == [
        ("a0", 0, -1),
        ("a1", 1, 0),
        ("a3", 3, 2),
    ]
    assert plan.drafts[0].forecaster is None
    assert plan.groups[0].job.inputs.features["position"][:, 1].tolist() == [4.0, 12.0]


def test_steps_and_context_reach_the_jobs() -> None:
    request = make_request(1, horizon=3.0, context=pb.CONTEXT_BLIND)
    add_agent(request, "bike", CYCLIST, y=30)
    plan = plan_of(request, FakeForecaster())
    own, fallback = (group.job for group in plan.groups)
    assert (own.steps, own.context) == (6, Context.BLIND)
    assert fallback.steps == 6
    assert not fallback.forecaster.info.supports_blind or fallback.context is Context.BLIND


def test_agents_that_were_read_before_are_not_read_again() -> None:
    fake, request = FakeForecaster(), make_request(2)
    agents = read_agents(request, SETTINGS)
    request.agents[1].ClearField("states")
    catalog = build_catalog(registry(fake), "fake")
    plan = make_plan(request, read_options(request, fake.info, SETTINGS), fake, catalog, SETTINGS, agents)
    assert plan.agents is agents
    assert [draft.status for draft in plan.drafts] == [OK, OK]


def test_without_usable_agents_there_is_no_scene() -> None:
    request = make_request(1)
    request.agents[0].ClearField("type")
    plan = plan_of(request, FakeForecaster())
    assert (plan.scene, plan.groups) == (None, [])
    assert plan.add_groups([]) == []


def test_history_is_long_enough_for_model_and_fallback() -> None:
    for frames in (1, 7):
        fake = FakeForecaster(history_frames=frames)
        catalog = build_catalog(registry(fake), "fake")
        assert frames_of(fake, catalog) == max(frames, catalog.fallback.info.history_frames)


def test_a_strict_call_names_every_agent_that_is_not_forecast_as_requested() -> None:
    request = make_request(2, strict=True)
    add_agent(request, "bike", CYCLIST, y=30)
    request.agents[0].ClearField("type")
    with pytest.raises(BadFields) as caught:
        plan_of(request, FakeForecaster())
    assert [fault.field for fault in caught.value.faults] == ["agents[0].type", "agents[2].type"]


def test_forecasts_that_are_not_finite_are_dropped_from_their_group() -> None:
    plan = plan_of(make_request(3), FakeForecaster())
    [group] = plan.groups
    broken = set_outcomes([group], [outcome(group, broken=(1,))])
    assert [draft.agent_id for draft in broken] == ["a1"]
    assert [draft.agent_id for draft in group.drafts] == ["a0", "a2"]
    assert group.outcome is not None
    assert group.outcome.mixture.origin[:, 1].tolist() == [0.0, 8.0]
    assert (group.outcome.queue, group.outcome.inference, group.outcome.batch_agents) == (0.1, 0.2, 3)


def test_broken_forecasts_are_replaced_once() -> None:
    plan = plan_of(make_request(3), FakeForecaster())
    [group] = plan.groups
    [replaced] = plan.replace_broken(set_outcomes([group], [outcome(group, broken=(0, 2))]))
    assert plan.groups == [group, replaced]
    assert replaced.job.forecaster is plan.fallback
    assert [(draft.agent_id, draft.status, draft.field) for draft in replaced.drafts] == [
        ("a0", FALLBACK, "agents[0]"),
        ("a2", FALLBACK, "agents[2]"),
    ]
    assert plan.drafts[0].detail == f"forecast by {FALLBACK_MODEL}: the forecast of fake was not finite"
    assert plan.replace_broken(set_outcomes([replaced], [outcome(replaced, broken=(1,))])) == []
    assert [draft.status for draft in plan.drafts] == [FALLBACK, OK, INVALID]
    assert plan.drafts[2].detail == f"the forecast of {FALLBACK_MODEL} was not finite"
    assert plan.drafts[2].forecaster is None


@pytest.mark.parametrize("name", ["log_weights", "means", "covariances", "origin"])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_every_tensor_of_a_forecast_must_be_finite(name: str, value: float) -> None:
    tensors = {
        "log_weights": torch.zeros(2, 3).log_softmax(1),
        "means": torch.zeros(2, 3, 4, 2),
        "covariances": torch.zeros(2, 3, 4, 2, 2),
        "origin": torch.zeros(2, 2, dtype=torch.float64),
    }
    assert finite(TrajectoryMixture(**tensors)).tolist() == [True, True]
    tensors[name][1].view(-1)[-1] = value
    assert finite(TrajectoryMixture(**tensors)).tolist() == [True, False]


def test_a_mode_without_weight_is_finite_but_not_a_mixture_of_them() -> None:
    weights = torch.tensor([[0.0, -torch.inf], [-torch.inf, -torch.inf]])
    mixture = TrajectoryMixture(
        weights, torch.zeros(2, 2, 1, 2), torch.zeros(2, 2, 1, 2, 2), torch.zeros(2, 2, dtype=torch.float64)
    )
    assert finite(mixture).tolist() == [True, False]
