"""Servers on free ports, and ways to call them."""

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from typing import Any

import grpc
import httpx
from google.rpc import error_details_pb2, status_pb2

from cab.forecast.v1 import consistency_service_pb2 as consistency_pb
from cab.forecast.v1 import prediction_service_pb2 as pb
from model.forecaster import Forecaster
from service.server import Server
from service.settings import Settings
from tests.service.fakes import registry

PREDICT = "/cab.forecast.v1.PredictionService/Predict"
GET_AGENT = "/cab.forecast.v1.ConsistencyService/GetAgentConsistency"


def settings(**values: Any) -> Settings:
    """Return settings with free ports and a short warm-up."""
    free: dict[str, Any] = {"http": "127.0.0.1:0", "grpc": "127.0.0.1:0", "max_batch_agents": 64}
    return Settings(**(free | values))


@asynccontextmanager
async def running(*forecasters: Forecaster, **values: Any) -> AsyncIterator[Server]:
    """Run a server with the baselines and the forecasters, the first of which is the default."""
    default = {"default_model": forecasters[0].info.name} if forecasters else {}
    server = Server(settings(**(default | values)), load=lambda _: registry(*forecasters))
    await server.start()
    for forecaster in forecasters:
        if hasattr(forecaster, "forget"):
            forecaster.forget()
    try:
        yield server
    finally:
        await server.stop()


@contextmanager
def in_thread(with_settings: Settings) -> Iterator[Server]:
    """Run a server in a loop and thread of its own, for blocking clients."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    async def start() -> Server:
        started = Server(with_settings)
        await started.start()
        return started

    try:
        server = asyncio.run_coroutine_threadsafe(start(), loop).result(120)
        try:
            yield server
        finally:
            asyncio.run_coroutine_threadsafe(server.stop(), loop).result(30)
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


async def until_waiting(server: Server, agents: int) -> None:
    """Wait until ``agents`` agents are queued."""
    await until(lambda: server.metrics.registry.get_sample_value("forecast_queue_agents") == agents)


def count(server: Server, transport: str, method: str, code: str) -> float:
    """Return the number of calls with that code."""
    labels = {"transport": transport, "method": method, "code": code}
    return server.metrics.registry.get_sample_value("forecast_requests_total", labels) or 0.0


async def until(condition: Callable[[], object], seconds: float = 10.0) -> None:
    """Wait until the condition holds."""
    async with asyncio.timeout(seconds):
        while not condition():  # noqa: ASYNC110 - no event tells
            await asyncio.sleep(0.005)


@dataclass
class CallError(Exception):
    """Error as a client sees it, on any transport."""

    code: str
    message: str
    reason: str
    faults: list[tuple[str, str]] = field(default_factory=list)
    retry_after: float | None = None
    http_status: int | None = None


async def call_grpc(
    server: Server,
    request: pb.PredictRequest | bytes,
    metadata: Mapping[str, str] | None = None,
    timeout: float | None = 20,  # noqa: ASYNC109 - it travels
) -> pb.PredictResponse:
    """Call Predict over gRPC."""
    body = request if isinstance(request, bytes) else request.SerializeToString()
    return pb.PredictResponse.FromString(await _invoke(server, PREDICT, body, metadata, timeout))


async def get_agent_grpc(
    server: Server,
    request: consistency_pb.GetAgentConsistencyRequest,
    metadata: Mapping[str, str] | None = None,
) -> consistency_pb.GetAgentConsistencyResponse:
    """Call GetAgentConsistency over gRPC."""
    answer = await _invoke(server, GET_AGENT, request.SerializeToString(), metadata, 20)
    return consistency_pb.GetAgentConsistencyResponse.FromString(answer)


async def _invoke(
    server: Server,
    method: str,
    body: bytes,
    metadata: Mapping[str, str] | None,
    timeout: float | None,  # noqa: ASYNC109
) -> bytes:
    options = [("grpc.max_receive_message_length", -1), ("grpc.use_local_subchannel_pool", 1)]
    async with grpc.aio.insecure_channel(server.grpc_address, options=options) as channel:
        try:
            answer: bytes = await channel.unary_unary(method, None, None)(
                body, metadata=tuple((metadata or {}).items()), timeout=timeout
            )
        except grpc.aio.AioRpcError as error:
            raise from_grpc(error) from error
    return answer


async def call_rest(
    server: Server,
    request: pb.PredictRequest | bytes,
    metadata: Mapping[str, str] | None = None,
    timeout: float | None = None,  # noqa: ASYNC109 - it travels
) -> pb.PredictResponse:
    """Call Predict over REST, with protobuf bodies."""
    headers = {"content-type": "application/x-protobuf"} | dict(metadata or {})
    if timeout is not None:
        headers["Request-Timeout"] = str(timeout)
    body = request if isinstance(request, bytes) else request.SerializeToString()
    async with httpx.AsyncClient(timeout=20) as client:
        response = await client.post(
            f"http://{server.http_address}/v1/predict", content=body, headers=headers
        )
    if response.status_code != httpx.codes.OK:
        raise from_problem(response)
    return pb.PredictResponse.FromString(response.content)


async def get_agent_rest(
    server: Server,
    request: consistency_pb.GetAgentConsistencyRequest,
    metadata: Mapping[str, str] | None = None,
) -> consistency_pb.GetAgentConsistencyResponse:
    """Call GetAgentConsistency over REST."""
    async with httpx.AsyncClient(timeout=20) as client:
        response = await client.get(
            f"http://{server.http_address}/v1/consistency/agent",
            params={field.name: value for field, value in request.ListFields()},
            headers={"accept": "application/x-protobuf"} | dict(metadata or {}),
        )
    if response.status_code != httpx.codes.OK:
        raise from_problem(response)
    return consistency_pb.GetAgentConsistencyResponse.FromString(response.content)


TRANSPORTS = {"grpc": call_grpc, "rest": call_rest}
GET_AGENT_BY = {"grpc": get_agent_grpc, "rest": get_agent_rest}


def from_problem(response: httpx.Response) -> CallError:
    """Return the error of a problem+json response."""
    assert response.headers["content-type"] == "application/problem+json", response.text
    problem = response.json()
    assert problem["status"] == response.status_code
    retry = response.headers.get("Retry-After")
    return CallError(
        problem["code"],
        problem["detail"],
        problem["reason"],
        [(fault["field"], fault["detail"]) for fault in problem["errors"]],
        None if retry is None else float(retry),
        response.status_code,
    )


def from_grpc(error: grpc.aio.AioRpcError) -> CallError:
    """Return the error in the status and details of a gRPC call."""
    failed = CallError(error.code().name, error.details() or "", "")
    trailing: Any = error.trailing_metadata() or ()
    for key, value in trailing:
        if key != "grpc-status-details-bin":
            continue
        status = status_pb2.Status.FromString(value)
        assert (status.code, status.message) == (error.code().value[0], error.details())
        for detail in status.details:
            info = error_details_pb2.ErrorInfo()
            bad = error_details_pb2.BadRequest()
            retry = error_details_pb2.RetryInfo()
            if detail.Unpack(info):
                assert info.domain == "cab-forecast"
                failed.reason = info.reason
            elif detail.Unpack(bad):
                failed.faults = [(v.field, v.description) for v in bad.field_violations]
            elif detail.Unpack(retry):
                failed.retry_after = retry.retry_delay.ToNanoseconds() / 1e9
    return failed
