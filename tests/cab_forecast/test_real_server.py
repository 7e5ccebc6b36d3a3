"""The client against the real server, on free ports."""

import asyncio
import math
from collections.abc import Iterator
from importlib import metadata
from typing import Any

import numpy as np
import pytest
from pydantic import SecretStr

from cab_forecast import (
    AsyncClient,
    BadRequest,
    Client,
    NotFound,
    Status,
    Tracking,
    Unauthenticated,
    UnknownTrack,
    demo_request,
    forecasts,
    tracking,
)
from service.server import Server
from service.settings import Settings
from tests.service.servers import in_thread

TOKEN = "a-token"  # noqa: S105
MODEL = "constant-velocity-yaw"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Run a server with the baselines."""
    settings = Settings(
        http="127.0.0.1:0",
        grpc="127.0.0.1:0",
        models=tmp_path_factory.mktemp("models"),
        default_model=MODEL,
        max_batch_agents=32,
        api_tokens=(SecretStr(TOKEN),),
        revision="abc123",
    )
    with in_thread(settings) as running:
        yield running


@pytest.fixture(params=["grpc", "http", "http-json"])
def arguments(request: pytest.FixtureRequest, server: Server) -> dict[str, Any]:
    """Return the arguments of a client for that server."""
    if request.param == "grpc":
        return {"endpoint": f"grpc://{server.grpc_address}", "token": TOKEN}
    encoding = "json" if request.param == "http-json" else "protobuf"
    return {"endpoint": f"http://{server.http_address}", "token": TOKEN, "encoding": encoding}


def test_tells_its_version(arguments: dict[str, Any]) -> None:
    with Client(**arguments) as client:
        told = client.get_version()
    assert (told.version, told.contract) == (metadata.version("cab-forecast"), "cab.forecast.v1")
    assert told.revision == "abc123"
    assert told.torch == metadata.version("torch")


def test_errors_name_the_request(arguments: dict[str, Any]) -> None:
    with Client(**arguments) as client, pytest.raises(NotFound) as caught:
        client.get_model("nobody")
    assert len(caught.value.request_id) == 32


def test_forecasts_the_demo(arguments: dict[str, Any]) -> None:
    request = demo_request()
    with Client(**arguments) as client:
        response = client.predict(request)
    views = forecasts(response)
    assert response.model.name == MODEL
    assert list(views) == [agent.id for agent in request.agents]
    for view in views.values():
        assert view.status in (Status.OK, Status.SHORT_HISTORY)
        assert view.weights.sum() + view.remaining_weight == pytest.approx(1.0)
        assert (np.linalg.eigvalsh(view.covariances) > 0).all()
    now = request.agents[0].states[-1]
    ahead = (
        6
        * math.hypot(now.velocity_x, now.velocity_y)
        * np.array([math.cos(now.heading), math.sin(now.heading)])
    )
    assert math.hypot(*ahead) > 5
    np.testing.assert_allclose(views["vehicle-3"].most_likely[-1], np.array([now.x, now.y]) + ahead, atol=0.5)


def test_samples_are_repeatable(arguments: dict[str, Any]) -> None:
    request = demo_request()
    request.options.samples, request.options.seed = 4, 11
    with Client(**arguments) as client:
        first, second = (forecasts(client.predict(request)) for _ in range(2))
    assert first["cyclist-10"].samples.shape == (4, 12, 2)
    np.testing.assert_array_equal(first["cyclist-10"].samples, second["cyclist-10"].samples)


async def test_asyncio(arguments: dict[str, Any]) -> None:
    async with AsyncClient(**arguments) as client:
        responses = await asyncio.gather(*(client.predict(demo_request()) for _ in range(4)))
    assert len({forecasts(response)["cyclist-10"].most_likely.tobytes() for response in responses}) == 1


def test_models(arguments: dict[str, Any]) -> None:
    with Client(**arguments) as client:
        models = client.list_models()
        assert {model.name for model in models} >= {MODEL, "kalman"}
        assert [model.name for model in models if model.is_default] == [MODEL]
        for model in models:
            assert client.get_model(f"{model.name}@{model.version}") == model
        with pytest.raises(NotFound) as caught:
            client.get_model("crystal-ball")
    assert caught.value.reason == "UNKNOWN_MODEL"


def test_consistency(arguments: dict[str, Any]) -> None:
    request = demo_request()
    request.options.consistency = True
    with Client(**arguments) as client:
        client.reset_scene("demo")
        with pytest.raises(UnknownTrack):
            client.scene_consistency("demo")
        with client.watch_scene("demo") as events:
            assert tracking(client.predict(request)) is not Tracking.UNAVAILABLE
            event = next(events)
        response = client.predict(request)
        view = forecasts(response)["cyclist-10"]
        assert (tracking(response), view.tracking) == (Tracking.OK, Tracking.OK)
        ids = {agent.id for agent in request.agents}
        assert {instant.agent_id for instant in event.instants} == ids
        assert {instant.agent_id for instant in client.scene_consistency("demo").latest} == ids
        assert client.agent_consistency("demo", "cyclist-10")[-1].time == request.time
        assert client.model_consistency() == []  # nothing settled yet
        assert client.reset_scene("demo") == len(ids)


def test_a_bad_field_is_named(arguments: dict[str, Any]) -> None:
    request = demo_request()
    request.ClearField("time")
    with Client(**arguments) as client, pytest.raises(BadRequest) as caught:
        client.predict(request)
    assert caught.value.reason == "BAD_FIELD"
    assert caught.value.field_violations[0].field == "time"


def test_a_wrong_token(arguments: dict[str, Any]) -> None:
    with Client(**{**arguments, "token": "guess"}) as client, pytest.raises(Unauthenticated):
        client.list_models()
