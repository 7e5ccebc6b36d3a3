"""``cab-forecast scenes`` against a real server."""

import json
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog
from typer.testing import CliRunner

from cab_forecast import Client
from cab_forecast.demo import demo_request
from cli.main import app
from service.server import Server
from tests.service.servers import in_thread, settings

run = CliRunner().invoke


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """Serve the baselines without logging, because server and command share their output."""
    models: Path = tmp_path_factory.mktemp("models")
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    with in_thread(settings(models=models)) as running:
        yield running
    structlog.reset_defaults()


@pytest.mark.parametrize("scheme", ["grpc", "http"])
def test_scenes_are_listed(server: Server, scheme: str) -> None:
    address = server.grpc_address if scheme == "grpc" else server.http_address
    endpoint = f"--endpoint={scheme}://{address}"
    if scheme == "grpc":
        assert "no scene was forecast lately" in run(app, ["scenes", endpoint]).output
    with Client(f"{scheme}://{address}") as client:
        client.predict(demo_request())
        assert [one.scene_id for one in client.list_scenes()] == ["demo"]
        with client.watch_forecasts("demo") as events:
            client.predict(demo_request())
            kinds = [next(events).WhichOneof("event") for _ in range(2)]
        assert kinds == ["map", "frame"]
    table = run(app, ["scenes", endpoint])
    assert table.exit_code == 0, table.output
    assert "demo" in table.output
    assert "kalman@1.0.0" in table.output
    [scene] = json.loads(run(app, ["scenes", endpoint, "--json"]).output)["scenes"]
    assert (scene["scene_id"], scene["agents"], scene["model"]["name"]) == (
        "demo",
        len(demo_request().agents),
        "kalman",
    )
