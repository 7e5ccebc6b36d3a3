"""State changes of a server, each in the log once, at warning."""

import pytest
from structlog.testing import capture_logs

from loadtest.redis_servers import free_port
from service.server import Server
from tests.service.requests import make_request
from tests.service.servers import TRANSPORTS, running, settings


@pytest.mark.parametrize("transport", TRANSPORTS)
async def test_a_redis_that_cannot_be_reached_is_in_the_log_at_the_start(transport: str) -> None:
    with capture_logs() as logs:
        async with running(store=f"redis://127.0.0.1:{free_port()}") as server:
            lost = [entry for entry in logs if entry["event"] == "track memory lost"]
            request = make_request()
            request.scene_id = "s"
            for _ in range(5):
                assert await TRANSPORTS[transport](server, request)
            errors = "forecast_track_store_errors_total"
            labels = {"op": "ping", "reason": "refused"}
            assert server.metrics.registry.get_sample_value(errors, labels) == 1
    [entry] = lost
    assert (entry["log_level"], entry["calls"], entry["reason"]) == ("warning", "forecasts", "refused")
    assert [entry for entry in logs if entry["event"] == "track memory lost"] == lost


async def test_models_and_drain_are_in_the_log_once() -> None:
    with capture_logs() as logs:
        server = Server(settings(default_model="kalman"))
        await server.start()
        await server.stop()
    seen = [(entry["event"], entry["log_level"]) for entry in logs]
    assert [one for one in seen if one[0] in ("models loaded", "draining")] == [
        ("models loaded", "warning"),
        ("draining", "warning"),
    ]
