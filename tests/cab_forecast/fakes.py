"""Fake servers on real sockets, which respond or fail as the contract's error table says."""

import json
import socket
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

import grpc
import uvicorn
from google.protobuf import any_pb2, duration_pb2, json_format
from google.protobuf.message import Message
from google.rpc import code_pb2, error_details_pb2, status_pb2
from grpc_status import rpc_status

from cab.forecast.v1.model_service_pb2 import (
    GetModelRequest,
    GetModelResponse,
    GetVersionRequest,
    GetVersionResponse,
    ListModelsRequest,
    ListModelsResponse,
    Model,
)
from cab.forecast.v1.model_service_pb2_grpc import ModelServiceServicer, add_ModelServiceServicer_to_server
from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse
from cab.forecast.v1.prediction_service_pb2_grpc import (
    PredictionServiceServicer,
    add_PredictionServiceServicer_to_server,
)
from tests.cab_forecast.answers import answer

PROTOBUF, JSON = "application/x-protobuf", "application/json"
HELD = 30.0
"""s, the longest that an answer is held back."""
MODELS = [Model(name="fan", version="1.0.0", is_default=True), Model(name="kalman", version="2.0.0")]

Answer = TypeVar("Answer", bound=Message)
Scope = Mapping[str, Any]
Receive = Callable[[], Awaitable[Mapping[str, Any]]]
Send = Callable[[Mapping[str, Any]], Awaitable[None]]


@dataclass(eq=False)
class Failure(Exception):  # noqa: N818
    """One row of the error table."""

    code: str
    status: int
    reason: str
    message: str = "it went wrong"
    violations: tuple[tuple[str, str], ...] = ()
    retry_after: float | None = None

    def as_rpc_status(self) -> status_pb2.Status:
        details: list[Message] = [error_details_pb2.ErrorInfo(reason=self.reason, domain="cab-forecast")]
        if self.violations:
            details.append(
                error_details_pb2.BadRequest(
                    field_violations=[
                        error_details_pb2.BadRequest.FieldViolation(field=name, description=why)
                        for name, why in self.violations
                    ]
                )
            )
        if self.retry_after is not None:
            delay = duration_pb2.Duration()
            delay.FromNanoseconds(round(self.retry_after * 1e9))
            details.append(error_details_pb2.RetryInfo(retry_delay=delay))
        packed = []
        for detail in details:
            packed.append(any_pb2.Any())
            packed[-1].Pack(detail)
        return status_pb2.Status(code=code_pb2.Code.Value(self.code), message=self.message, details=packed)

    def as_problem(self) -> bytes:
        problem = {"type": "urn:x", "title": "Oh", "status": self.status, "detail": self.message}
        errors = [{"field": name, "detail": why} for name, why in self.violations]
        return json.dumps(problem | {"code": self.code, "reason": self.reason, "errors": errors}).encode()


@dataclass(eq=False)
class Raw(Exception):  # noqa: N818
    """An HTTP response outside the contract, such as a gateway's."""

    status: int
    body: bytes
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass
class Script:
    """Script of a fake server: the given failures, call by call, then responses."""

    failures: list[Failure | Raw] = field(default_factory=list)
    held: threading.Event | None = None
    """Answers wait for this to be set, ``HELD`` at most."""
    calls: list[Mapping[str, str]] = field(default_factory=list)
    """Headers of each call; "timeout" is what was left of the call's time, s."""
    times: list[float] = field(default_factory=list)
    """Times at which calls came, s, monotonic."""
    predicted: list[PredictRequest] = field(default_factory=list)

    def play(self, headers: Mapping[str, str]) -> None:
        """Record one call, and raise the failure in the script."""
        self.calls.append(headers)
        self.times.append(time.monotonic())
        if self.held is not None:
            self.held.wait(HELD)
        if self.failures:
            raise self.failures.pop(0)

    def predict(self, request: PredictRequest) -> PredictResponse:
        self.predicted.append(request)
        return answer(request)

    def get_model(self, name: str) -> GetModelResponse:
        for model in MODELS:
            if name in (model.name, f"{model.name}@{model.version}"):
                return GetModelResponse(model=model)
        raise Failure("NOT_FOUND", 404, "UNKNOWN_MODEL", f"no model {name}")


class _GrpcFake(PredictionServiceServicer, ModelServiceServicer):
    def __init__(self, script: Script) -> None:
        self.script = script

    def Predict(self, request: PredictRequest, context: Any) -> PredictResponse:  # noqa: N802
        return self._answer(context, lambda: self.script.predict(request))

    def ListModels(self, request: ListModelsRequest, context: Any) -> ListModelsResponse:  # noqa: N802
        return self._answer(context, lambda: ListModelsResponse(models=MODELS))

    def GetVersion(self, request: GetVersionRequest, context: Any) -> GetVersionResponse:  # noqa: N802
        return self._answer(context, GetVersionResponse)

    def GetModel(self, request: GetModelRequest, context: Any) -> GetModelResponse:  # noqa: N802
        return self._answer(context, lambda: self.script.get_model(request.name))

    def _answer(self, context: Any, make: Callable[[], Answer]) -> Answer:
        try:
            self.script.play(
                {**dict(context.invocation_metadata()), "timeout": str(context.time_remaining())}
            )
            return make()
        except Failure as failure:
            context.abort_with_status(rpc_status.to_status(failure.as_rpc_status()))
            raise


@contextmanager
def grpc_fake(
    script: Script, credentials: grpc.ServerCredentials | None = None, port: int = 0
) -> Iterator[str]:
    """Run a gRPC server that follows the script; yield ``host:port``."""
    server = grpc.server(ThreadPoolExecutor(4))
    fake = _GrpcFake(script)
    add_PredictionServiceServicer_to_server(fake, server)
    add_ModelServiceServicer_to_server(fake, server)
    if credentials is None:
        port = server.add_insecure_port(f"127.0.0.1:{port}")
    else:
        port = server.add_secure_port(f"127.0.0.1:{port}", credentials)
    server.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        server.stop(None).wait()


class _HttpFake:
    """A tiny ASGI application."""

    def __init__(self, script: Script) -> None:
        self.script = script

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        body, more = b"", True
        while more:
            event = await receive()
            body, more = body + event.get("body", b""), event.get("more_body", False)
        headers = {name.decode(): value.decode() for name, value in scope["headers"]}
        try:
            self.script.play({**headers, "timeout": headers.get("request-timeout", "")})
            status, content, sent = 200, *self._answer(scope, headers, body)
        except Failure as failure:
            status, content = failure.status, failure.as_problem()
            sent = {"content-type": "application/problem+json"}
            if failure.retry_after is not None:
                sent["retry-after"] = str(failure.retry_after)
        except Raw as raw:
            status, content, sent = raw.status, raw.body, dict(raw.headers)
        fields = [(name.encode(), value.encode()) for name, value in sent.items()]
        await send({"type": "http.response.start", "status": status, "headers": fields})
        await send({"type": "http.response.body", "body": content})

    def _answer(self, scope: Scope, headers: Mapping[str, str], body: bytes) -> tuple[bytes, dict[str, str]]:
        media_type = JSON if JSON in headers["accept"] else PROTOBUF
        match scope["method"], scope["path"].removeprefix("/gateway"):
            case "POST", "/v1/predict":
                assert headers["content-type"] == media_type
                request = PredictRequest()
                if media_type == JSON:
                    json_format.Parse(body, request)
                else:
                    request.ParseFromString(body)
                message: Message = self.script.predict(request)
            case "GET", "/v1/models":
                message = ListModelsResponse(models=MODELS)
            case "GET", path if path.startswith("/v1/models/"):
                message = self.script.get_model(path.removeprefix("/v1/models/"))
            case _:
                raise Raw(404, b"nothing here", {"content-type": "text/plain"})
        content = (
            json_format.MessageToJson(message).encode() if media_type == JSON else message.SerializeToString()
        )
        return content, {"content-type": f"{media_type}; charset=utf-8"}


@contextmanager
def http_fake(
    script: Script, port: int = 0, ssl_keyfile: str | None = None, ssl_certfile: str | None = None
) -> Iterator[str]:
    """Run an HTTP server that follows the script; yield ``host:port``."""
    config = uvicorn.Config(
        _HttpFake(script),
        loop="asyncio",
        http="h11",
        ws="none",
        lifespan="off",
        log_config=None,
        ssl_keyfile=ssl_keyfile,
        ssl_certfile=ssl_certfile,
    )
    server = uvicorn.Server(config)
    with socket.create_server(("127.0.0.1", port)) as listener:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            while not server.started:
                time.sleep(0.005)
            yield f"127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()


@contextmanager
def trickling_server() -> Iterator[str]:
    """Run an HTTP server that responds at once, then sends the body byte by byte; yield ``host:port``."""
    head = f"HTTP/1.1 200 OK\r\ncontent-type: {PROTOBUF}\r\ncontent-length: 400\r\n\r\n"
    with raw_server(head.encode(), b"\0") as address:
        yield address


@contextmanager
def raw_server(head: bytes, drip: bytes | None) -> Iterator[str]:
    """Run a server for one connection; yield ``host:port``.

    Args:
        head: bytes sent once the client has connected and sent something.
        drip: bytes sent repeatedly after the head; None: the server closes the connection.
    """
    over = threading.Event()

    def serve(listener: socket.socket) -> None:
        connection, _ = listener.accept()
        with connection, suppress(ConnectionError):
            connection.recv(2**16)
            connection.sendall(head)
            while drip is not None and not over.wait(0.05):
                connection.sendall(drip)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        try:
            yield f"127.0.0.1:{listener.getsockname()[1]}"
        finally:
            over.set()
            thread.join()


def free_port() -> int:
    """Return a port without a listener."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])
