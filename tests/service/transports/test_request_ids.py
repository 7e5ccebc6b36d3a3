"""Request ids in responses, errors and logs, and the access log, on both transports."""

from collections.abc import Mapping
from typing import Any

import grpc
import httpx
import pytest
import structlog
from google.rpc import error_details_pb2, status_pb2
from structlog.testing import capture_logs

from service.server import Server
from tests.service.fakes import FakeForecaster
from tests.service.planes import with_fake_plane
from tests.service.requests import make_request
from tests.service.servers import PREDICT, running

TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"
PARENT = f"00-{TRACE}-00f067aa0ba902b7-01"
LIST_MODELS = "/cab.forecast.v1.ModelService/ListModels"
Sent = Mapping[str, str]


async def grpc_ids(server: Server, sent: Sent, body: bytes, method: str = PREDICT) -> tuple[str, str, str]:
    """Return the status code of a call, and the id in its trailing metadata and in its error."""
    async with grpc.aio.insecure_channel(server.grpc_address) as channel:
        call = channel.unary_unary(method, None, None)(body, metadata=tuple(sent.items()), timeout=20)
        trailing: Any = dict(await call.trailing_metadata())
        code = (await call.code()).name
    told = error_details_pb2.RequestInfo()
    status = status_pb2.Status.FromString(trailing.get("grpc-status-details-bin", b""))
    for detail in status.details:
        detail.Unpack(told)
    return code, trailing["x-request-id"], told.request_id


async def rest_ids(
    server: Server, sent: Sent, body: bytes, path: str = "/v1/predict"
) -> tuple[str, str, str]:
    """Return the status code of a call, and the id in its header and in its error."""
    headers = {"content-type": "application/x-protobuf"} | dict(sent)
    async with httpx.AsyncClient(timeout=20) as client:
        response = await client.post(f"http://{server.http_address}{path}", content=body, headers=headers)
    problem = {} if response.is_success else response.json()
    return problem.get("code", "OK"), response.headers["x-request-id"], problem.get("request_id", "")


IDS = {"grpc": grpc_ids, "rest": rest_ids}


@pytest.mark.parametrize("transport", IDS)
async def test_ids_are_taken_from_the_caller(transport: str) -> None:
    request = make_request().SerializeToString()
    unknown = make_request(model="nobody").SerializeToString()
    ids = IDS[transport]
    async with running() as server:
        assert await ids(server, {"x-request-id": "tick-17"}, request) == ("OK", "tick-17", "")
        assert await ids(server, {"traceparent": PARENT}, request) == ("OK", TRACE, "")
        code, made, told = await ids(server, {}, unknown)
        assert (code, len(made)) == ("NOT_FOUND", 32)
        assert told == made
        assert await ids(server, {"x-request-id": "tick-18"}, unknown) == ("NOT_FOUND", "tick-18", "tick-18")


@pytest.mark.parametrize("transport", IDS)
async def test_refusals_for_want_of_a_key_have_an_id(transport: str) -> None:
    async with running(api_tokens=("right",)) as server:
        seen = await IDS[transport](server, {"x-request-id": "tick-17"}, b"")
    assert seen == ("UNAUTHENTICATED", "tick-17", "tick-17")


async def test_what_is_not_of_the_contract_has_an_id_too() -> None:
    async with running() as server, httpx.AsyncClient() as client:
        for path in ("/livez", "/metrics", "/nothing", "/v1/consistency/events"):
            response = await client.get(f"http://{server.http_address}{path}", headers={"x-request-id": "p"})
            assert response.headers["x-request-id"] == "p"
            assert response.is_success or response.json()["request_id"] == "p"


async def test_streams_have_an_id() -> None:
    headers = {"x-request-id": "watch", "accept": "text/event-stream", "Request-Timeout": "0.1"}
    async with running() as server, httpx.AsyncClient() as client:
        with_fake_plane(server)
        url = f"http://{server.http_address}/v1/consistency/events"
        response = await client.get(url, params={"scene_id": "s"}, headers=headers)
        assert (response.status_code, response.headers["x-request-id"]) == (200, "watch")


@pytest.mark.parametrize("transport", IDS)
async def test_errors_in_the_log_name_the_request(transport: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise KeyError("a bug")

    async with running() as server:
        monkeypatch.setattr("service.predict.pipeline.make_plan", fail)
        with capture_logs(processors=[structlog.contextvars.merge_contextvars]) as logs:
            sent = {"x-request-id": "tick-17", "traceparent": PARENT}
            code, *_ = await IDS[transport](server, sent, make_request().SerializeToString())
    assert code == "INTERNAL"
    [entry] = [entry for entry in logs if entry["event"] == "unexpected error"]
    assert (entry["request_id"], entry["trace_id"]) == ("tick-17", TRACE)


@pytest.mark.parametrize("transport", IDS)
async def test_a_failed_forward_names_its_requests(transport: str) -> None:
    fake = FakeForecaster()
    async with running(fake) as server:
        fake.broken = True
        with capture_logs() as logs:
            await IDS[transport](server, {"x-request-id": "tick-17"}, make_request().SerializeToString())
        fake.broken = False
    [entry] = [entry for entry in logs if entry["event"] == "forward failed"]
    assert entry["request_ids"] == ["tick-17"]


@pytest.mark.parametrize("transport", IDS)
@pytest.mark.parametrize(("share", "level"), [(0.0, "debug"), (1.0, "info")])
async def test_each_call_has_a_line(transport: str, share: float, level: str) -> None:
    ids = IDS[transport]
    async with running(access_log=share, api_tokens=("right",)) as server:
        with capture_logs(processors=[structlog.contextvars.merge_contextvars]) as logs:
            key = {"authorization": "Bearer right"}
            await ids(server, key | {"x-request-id": "a"}, make_request().SerializeToString())
            await ids(server, key | {"x-request-id": "b"}, make_request(model="no").SerializeToString())
            await ids(server, {"x-request-id": "c"}, b"")
    lines = [entry for entry in logs if entry["event"] == "call"]
    assert [(line["request_id"], line["code"], line.get("reason")) for line in lines] == [
        ("a", "OK", None),
        ("b", "NOT_FOUND", "UNKNOWN_MODEL"),
        ("c", "UNAUTHENTICATED", "UNAUTHENTICATED"),
    ]
    assert {(line["log_level"], line["transport"], line["method"]) for line in lines} == {
        (level, transport, "Predict")
    }
    assert all(line["seconds"] > 0 for line in lines)
    assert [line.get("key") for line in lines] == ["(api_tokens)", "(api_tokens)", None]


async def test_both_transports_sample_the_same_requests() -> None:
    logged = {}
    async with running(access_log=0.3) as server:
        for transport, ids in (("grpc", grpc_ids), ("rest", rest_ids)):
            with capture_logs(processors=[structlog.contextvars.merge_contextvars]) as logs:
                for number in range(40):
                    await ids(server, {"x-request-id": f"r{number}"}, b"\xff")
            calls = [entry for entry in logs if entry["log_level"] == "info" and "request_id" in entry]
            logged[transport] = {entry["request_id"] for entry in calls}
    assert logged["grpc"] == logged["rest"]
    assert 0 < len(logged["grpc"]) < 40
