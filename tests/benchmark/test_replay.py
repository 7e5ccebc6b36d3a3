"""Replay: every call once, with bounded concurrency; errors are reported."""

import asyncio
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from benchmark import replay as replay_module
from benchmark.archive import Archive
from benchmark.errors import BenchmarkError
from benchmark.plan import Call
from benchmark.replay import Replay, Replayed, keep_most_likely
from cab.forecast.v1.model_service_pb2 import Model
from cab.forecast.v1.prediction_service_pb2 import AgentForecast, PredictRequest, PredictResponse
from cab_forecast import (
    AsyncClient,
    BadRequest,
    DeadlineExceeded,
    ForecastError,
    InternalError,
    NotFound,
    Unavailable,
    forecasts,
)
from model.forecaster import Protocol
from tests.benchmark.scenes import planned

MODELS = {f"{name}@1.0.0": Model(name=name, version="1.0.0", history_frames=5) for name in ("one", "two")}
FORECASTS = sum(scene.forecasts for scene in planned())
CALLS = sum(len(scene.calls) for scene in planned())


class Endpoint:
    """Endpoint that records its requests."""

    def __init__(self, fails: dict[int, ForecastError] | None = None) -> None:
        self.requests: list[PredictRequest] = []
        self.most = self._now = 0
        self._fails = fails or {}

    async def predict(self, request: PredictRequest, timeout: float) -> PredictResponse:  # noqa: ASYNC109
        number = len(self.requests)
        self.requests.append(request)
        self._now += 1
        self.most = max(self.most, self._now)
        await asyncio.sleep(0)
        self._now -= 1
        if number in self._fails:
            raise self._fails[number]
        return PredictResponse(time=request.time, steps=12, step=0.5)


def run(folder: Path, endpoint: Endpoint, concurrency: int = 3) -> tuple[Replayed, list[int]]:
    """Outcome of a replay of both scenes, and its ticks."""
    ticks: list[int] = []
    replay = Replay(planned(), MODELS, Protocol.CAUSAL, concurrency)
    assert replay.forecasts() == 2 * FORECASTS
    with Archive(folder) as archive:
        return asyncio.run(replay.run(cast(AsyncClient, endpoint), archive, ticks.append)), ticks


def test_every_call_is_made_once_for_every_model(tmp_path: Path) -> None:
    endpoint = Endpoint()
    replayed, ticks = run(tmp_path, endpoint)
    called = [(request.model, request.time, request.agents[0].states[-1].x) for request in endpoint.requests]
    assert len(called) == len(set(called)) == 2 * CALLS
    assert endpoint.most == 3
    assert replayed.requested == sum(ticks) == 2 * FORECASTS
    assert not replayed.refused


def test_saved_answers_are_not_requested_again(tmp_path: Path) -> None:
    lost = Unavailable("gone")
    with pytest.raises(BenchmarkError, match="does not answer: gone; answers so far are kept"):
        run(tmp_path, Endpoint({20: lost}), concurrency=1)
    endpoint = Endpoint()
    replayed, ticks = run(tmp_path, endpoint)
    assert len(endpoint.requests) == 2 * CALLS - 20
    assert sum(ticks) == 2 * FORECASTS
    assert replayed.requested < 2 * FORECASTS
    endpoint = Endpoint()
    assert run(tmp_path, endpoint)[0].requested == 0
    assert not endpoint.requests


def test_a_refused_call_costs_no_other(tmp_path: Path) -> None:
    endpoint = Endpoint({2: BadRequest("agents[1].id is wrong")})
    replayed, _ = run(tmp_path, endpoint, concurrency=1)
    assert replayed.refused == 1
    with Archive(tmp_path, read_only=True) as archive:
        (refusal,) = archive.refusals()
    assert (refusal.model, refusal.scene, refusal.why) == ("one@1.0.0", "scene-1", "agents[1].id is wrong")
    assert refusal.frame / 2 == endpoint.requests[2].time
    assert len(endpoint.requests) == 2 * CALLS


def test_a_refused_call_is_forgotten_once_it_has_an_answer(tmp_path: Path) -> None:
    run(tmp_path, Endpoint({2: InternalError("oh")}), concurrency=1)
    endpoint = Endpoint()
    run(tmp_path, endpoint)
    assert len(endpoint.requests) == 1
    with Archive(tmp_path, read_only=True) as archive:
        assert not archive.refusals()


def test_a_missed_deadline_is_retried(tmp_path: Path) -> None:
    endpoint = Endpoint({2: DeadlineExceeded("late"), 3: DeadlineExceeded("late")})
    replayed, _ = run(tmp_path, endpoint, concurrency=1)
    assert not replayed.refused
    assert endpoint.requests[2] == endpoint.requests[3] == endpoint.requests[4]
    assert len(endpoint.requests) == 2 * CALLS + 2


def test_an_endpoint_that_refuses_everything_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_module, "MAX_REFUSED", 5)
    endpoint = Endpoint({number: BadRequest("no") for number in range(3, 100)})
    with pytest.raises(BenchmarkError, match="the endpoint refuses: no; answers so far are kept"):
        run(tmp_path, endpoint, concurrency=1)
    assert len(endpoint.requests) == 8


def test_an_endpoint_without_the_model_says_so(tmp_path: Path) -> None:
    with pytest.raises(BenchmarkError, match="the endpoint refuses: no model one"):
        run(tmp_path, Endpoint({0: NotFound("no model one")}))


def test_of_what_is_not_due_the_likeliest_mode_stays() -> None:
    scene = planned()[0]
    rng = np.random.default_rng(0)
    response = PredictResponse(time=2.0, steps=12, step=0.5)
    for track in (0, 1):
        response.forecasts.append(
            AgentForecast(
                agent_id=scene.record.tracks[track].id,
                mode_ids=[4, 9, 2],
                weights=[0.2, 0.5, 0.3],
                means=rng.normal(size=72).tolist(),
                covariances=rng.normal(size=108).tolist(),
                most_likely_mode=1,
            )
        )
    whole = PredictResponse.FromString(response.SerializeToString())
    keep_most_likely(response, Call(4, (0, 1), frozenset({1})), scene)
    assert response.forecasts[1] == whole.forecasts[1]
    kept, before = (forecasts(one)[scene.record.tracks[0].id] for one in (response, whole))
    np.testing.assert_array_equal(kept.most_likely, before.most_likely)
    np.testing.assert_array_equal(kept.covariances[0], before.covariances[1])
    assert kept.mode_ids.tolist() == [9]
    assert kept.weights.tolist() == [0.5]
    assert kept.remaining_weight == pytest.approx(0.5)
