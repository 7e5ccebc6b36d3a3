"""Calls over both transports, by both kinds of client."""

import gzip
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cab.forecast.v1.model_service_pb2 import ListModelsResponse
from cab_forecast import (
    AsyncClient,
    BadRequest,
    Client,
    DeadlineExceeded,
    FieldViolation,
    ForecastError,
    InternalError,
    NotFound,
    Overloaded,
    PermissionDenied,
    TooLarge,
    Unauthenticated,
    Unavailable,
    UnknownRaster,
    demo_request,
)
from tests.cab_forecast.answers import answer
from tests.cab_forecast.fakes import (
    HELD,
    MODELS,
    Failure,
    Raw,
    Script,
    free_port,
    grpc_fake,
    http_fake,
    trickling_server,
)

Call = Callable[..., Any]
QUICK = {"retries": 0}

ROWS = [
    (
        Failure(
            "INVALID_ARGUMENT", 422, "BAD_FIELD", "bad", violations=(("agents[0].states[1].x", "not finite"),)
        ),
        BadRequest,
    ),
    (Failure("UNAUTHENTICATED", 401, "UNAUTHENTICATED"), Unauthenticated),
    (Failure("NOT_FOUND", 404, "UNKNOWN_MODEL"), NotFound),
    (Failure("FAILED_PRECONDITION", 412, "UNKNOWN_RASTER"), UnknownRaster),
    (Failure("RESOURCE_EXHAUSTED", 413, "TOO_LARGE"), TooLarge),
    (Failure("RESOURCE_EXHAUSTED", 429, "OVERLOADED", retry_after=0.25), Overloaded),
    (Failure("DEADLINE_EXCEEDED", 504, "DEADLINE_EXCEEDED"), DeadlineExceeded),
    (Failure("UNAVAILABLE", 503, "DRAINING", retry_after=1.5), Unavailable),
    (Failure("CANCELLED", 499, ""), Unavailable),
    (Failure("INTERNAL", 500, "INTERNAL"), InternalError),
    (Failure("UNIMPLEMENTED", 405, "METHOD_NOT_ALLOWED"), ForecastError),
]


def test_predicts(call: Call, script: Script) -> None:
    request = demo_request()
    assert call({}, "predict", request) == answer(request)
    assert script.predicted == [request]


def test_lists_and_gets_models(call: Call) -> None:
    assert call({}, "list_models") == MODELS
    assert call({}, "get_model", "fan") == MODELS[0]
    assert call({}, "get_model", "kalman@2.0.0") == MODELS[1]


def test_unknown_model(call: Call) -> None:
    with pytest.raises(NotFound, match="no model a/b c") as caught:
        call({}, "get_model", "a/b c")
    assert caught.value.reason == "UNKNOWN_MODEL"


def test_empty_model_name_is_refused_here(call: Call, script: Script) -> None:
    with pytest.raises(ValueError, match="empty"):
        call({}, "get_model", "")
    assert not script.calls


def test_token_goes_along(call: Call, script: Script) -> None:
    call({"token": "s3cret"}, "list_models")
    call({}, "list_models")
    assert script.calls[0]["authorization"] == "Bearer s3cret"
    assert "authorization" not in script.calls[1]


def test_timeout_goes_along(call: Call, script: Script) -> None:
    call({"timeout": 3.0}, "list_models")
    call({"timeout": 3.0}, "list_models", timeout=1.5)
    # gRPC rounds deadlines, and reads them by another clock.
    assert 2.0 < float(script.calls[0]["timeout"]) <= 3.1
    assert 0.5 < float(script.calls[1]["timeout"]) <= 1.6


@pytest.mark.parametrize(("failure", "kind"), ROWS, ids=lambda row: getattr(row, "reason", ""))
def test_each_row_of_the_error_table(
    call: Call, script: Script, failure: Failure, kind: type[ForecastError]
) -> None:
    script.failures = [failure]
    with pytest.raises(ForecastError) as caught:
        call(QUICK, "predict", demo_request())
    error = caught.value
    assert type(error) is kind
    assert (error.code, error.message, error.reason) == (failure.code, failure.message, failure.reason)
    assert error.retry_after == failure.retry_after
    assert error.field_violations == tuple(FieldViolation(*violation) for violation in failure.violations)


def test_text_of_an_error_names_the_fields() -> None:
    error = BadRequest(
        "two bad fields: time", field_violations=[FieldViolation("time", "a"), FieldViolation("x", "b")]
    )
    assert str(error) == "two bad fields: time; x: b"


def test_overload_is_retried_until_it_is_over(call: Call, script: Script) -> None:
    script.failures = [Failure("RESOURCE_EXHAUSTED", 429, "OVERLOADED", retry_after=0.01)] * 2
    assert call({}, "list_models") == MODELS
    assert len(script.calls) == 3


def test_retries_end(call: Call, script: Script) -> None:
    script.failures = [Failure("UNAVAILABLE", 503, "STARTING", retry_after=0.01)] * 9
    with pytest.raises(Unavailable):
        call({}, "list_models")
    assert len(script.calls) == 3
    with pytest.raises(Unavailable):
        call({"retries": 1}, "list_models")
    assert len(script.calls) == 5


@pytest.mark.parametrize("row", [row for row in ROWS if not row[1].retryable], ids=lambda row: row[0].reason)
def test_what_cannot_get_better_is_not_retried(
    call: Call, script: Script, row: tuple[Failure, type[ForecastError]]
) -> None:
    script.failures = [row[0]] * 3
    with pytest.raises(row[1]):
        call({}, "list_models")
    assert len(script.calls) == 1


def test_waits_as_long_as_the_server_asks(call: Call, script: Script) -> None:
    script.failures = [Failure("RESOURCE_EXHAUSTED", 429, "OVERLOADED", retry_after=0.3)]
    call({}, "list_models")
    first, second = script.times
    assert 0.29 <= second - first < 2.0


def test_does_not_wait_beyond_its_timeout(call: Call, script: Script) -> None:
    script.failures = [Failure("RESOURCE_EXHAUSTED", 429, "OVERLOADED", retry_after=60.0)]
    start = time.monotonic()
    with pytest.raises(Overloaded):
        call({}, "list_models", timeout=10.0)
    assert time.monotonic() - start < 10.0
    assert len(script.calls) == 1


def test_a_retry_has_only_what_is_left_of_the_timeout(call: Call, script: Script) -> None:
    script.failures = [Failure("RESOURCE_EXHAUSTED", 429, "OVERLOADED", retry_after=0.3)]
    call({}, "list_models", timeout=2.0)
    assert float(script.calls[1]["timeout"]) < 1.8


def test_a_late_answer_is_a_deadline_exceeded(call: Call, script: Script) -> None:
    script.held = threading.Event()
    start = time.monotonic()
    with pytest.raises(DeadlineExceeded, match=r"^no response within 1 s$"):  # over both transports
        call({}, "list_models", timeout=1.0)
    # Closing a client does not wait for the answer either
    assert time.monotonic() - start < HELD / 2
    assert len(script.calls) == 1
    script.held.set()


def test_a_body_that_trickles_is_late_too(call_at: Call) -> None:
    with trickling_server() as address:
        start = time.monotonic()
        with pytest.raises(DeadlineExceeded, match=r"within 0\.4 s"):
            call_at(f"http://{address}", {}, "list_models", timeout=0.4)
        assert 0.35 < time.monotonic() - start < 10  # it would have come after 20 s


def test_a_gateway_may_compress(call_at: Call, script: Script) -> None:
    content = ListModelsResponse(models=MODELS).SerializeToString()
    headers = {"content-type": "application/x-protobuf", "content-encoding": "gzip"}
    script.failures = [Raw(200, gzip.compress(content), headers)]
    with http_fake(script) as address:
        assert call_at(f"http://{address}", {}, "list_models") == MODELS


@pytest.mark.parametrize("scheme", ["grpc", "http"])
def test_refused_connection_names_the_endpoint(call_at: Call, scheme: str) -> None:
    endpoint = f"{scheme}://127.0.0.1:{free_port()}"
    with pytest.raises(Unavailable, match=endpoint) as caught:
        call_at(endpoint, {}, "list_models")
    assert caught.value.reason == "UNREACHABLE"


@pytest.mark.parametrize(("scheme", "fake"), [("grpc", grpc_fake), ("http", http_fake)])
def test_a_server_that_comes_back_is_found_again(script: Script, scheme: str, fake: Any) -> None:
    port = free_port()
    with Client(f"{scheme}://127.0.0.1:{port}", retries=20) as client:
        for _ in range(2):
            with fake(script, port=port):
                assert client.list_models() == MODELS
            with pytest.raises((Unavailable, DeadlineExceeded)):  # whichever comes first
                client.list_models(timeout=0.3)


def test_a_closed_client_refuses_calls() -> None:
    client = Client("http://127.0.0.1:1")
    client.close()
    with pytest.raises(RuntimeError, match="closed"):
        client.list_models()


async def test_a_closed_asyncio_client_refuses_calls() -> None:
    client = AsyncClient()
    await client.close()
    with pytest.raises(RuntimeError, match="closed"):
        await client.list_models()


def test_paths_of_a_gateway_are_kept(call_at: Call, script: Script) -> None:
    with http_fake(script) as address:
        assert call_at(f"http://{address}/gateway/", {}, "list_models") == MODELS
        with pytest.raises(NotFound, match="404"):
            call_at(f"http://{address}/elsewhere", {}, "list_models")


@pytest.mark.parametrize(
    ("status", "kind", "reason"),
    [
        (400, BadRequest, ""),
        (403, PermissionDenied, ""),
        (413, TooLarge, "TOO_LARGE"),
        (429, Overloaded, ""),
        (502, Unavailable, ""),
        (504, DeadlineExceeded, ""),
        (500, InternalError, ""),
        (301, ForecastError, ""),
        (418, ForecastError, ""),
    ],
)
def test_a_gateways_errors_are_told_by_their_status(
    call_at: Call, script: Script, status: int, kind: type[ForecastError], reason: str
) -> None:
    script.failures = [Raw(status, b"<html>", {"content-type": "text/html"})]
    with http_fake(script) as address, pytest.raises(ForecastError, match=f"HTTP {status}") as caught:
        call_at(f"http://{address}", QUICK, "list_models")
    assert type(caught.value) is kind
    assert caught.value.reason == reason


@pytest.mark.parametrize(
    ("value", "seconds"),
    [
        ("7", 7.0),
        ("-1", 0.0),
        ("Thu, 01 Jan 1970 00:00:00 GMT", 0.0),
        ("soon", None),
        ("nan", None),
        ("inf", None),
    ],
)
def test_retry_after_may_be_a_date_or_nonsense(script: Script, value: str, seconds: float | None) -> None:
    script.failures = [Raw(429, b"", {"retry-after": value})]
    with (
        http_fake(script) as address,
        pytest.raises(Overloaded) as caught,
        Client(f"http://{address}", retries=0) as c,
    ):
        c.list_models()
    assert caught.value.retry_after == seconds


@pytest.mark.parametrize(
    ("body", "media_type", "match"),
    [
        (b"<html>hello</html>", "text/html", "is it a cab-forecast server"),
        (b"\xff\xff\xff", "application/x-protobuf", "cannot be parsed"),
        (b"{]", "application/json", "cannot be parsed"),
        (b"\xff", "application/json", "cannot be parsed"),
    ],
)
def test_answers_that_are_none(
    call_at: Call, script: Script, body: bytes, media_type: str, match: str
) -> None:
    script.failures = [Raw(200, body, {"content-type": media_type})]
    with http_fake(script) as address, pytest.raises(InternalError, match=match):
        call_at(f"http://{address}", {}, "list_models")


@pytest.mark.parametrize("body", [b"{", b"[1]", b'{"errors": [1, {"field": "a"}], "detail": "no"}'])
def test_broken_problems_are_still_errors(script: Script, body: bytes) -> None:
    script.failures = [Raw(422, body, {"content-type": "application/problem+json"})]
    with http_fake(script) as address, Client(f"http://{address}") as client, pytest.raises(BadRequest):
        client.list_models()


@pytest.mark.parametrize(
    "arguments",
    [
        {"timeout": 0},
        {"timeout": -1.0},
        {"timeout": float("nan")},
        {"timeout": float("inf")},
        {"retries": -1},
        {"encoding": "xml", "endpoint": "http://h"},
        {"encoding": "json", "endpoint": "grpc://h"},
        {"endpoint": "ftp://h"},
    ],
)
def test_bad_arguments_are_refused_at_once(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        Client(**arguments)


@pytest.mark.parametrize("scheme", ["grpcs", "https"])
def test_tls_with_an_own_certificate(
    call_at: Call, script: Script, scheme: str, certificate: tuple[Path, Path]
) -> None:
    import grpc

    key, chain = certificate
    if scheme == "grpcs":
        credentials = grpc.ssl_server_credentials([(key.read_bytes(), chain.read_bytes())])
        server = grpc_fake(script, credentials)
    else:
        server = http_fake(script, ssl_keyfile=str(key), ssl_certfile=str(chain))
    with server as address:
        port = address.rpartition(":")[2]
        assert call_at(f"{scheme}://localhost:{port}", {"ca_file": chain}, "list_models") == MODELS
        with pytest.raises(Unavailable):
            call_at(f"{scheme}://localhost:{port}", QUICK, "list_models")


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Create a key and a self-signed certificate for localhost."""
    folder = tmp_path_factory.mktemp("tls")
    key, chain = folder / "key.pem", folder / "chain.pem"
    command = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-days",
        "1",
        "-subj",
        "/CN=localhost",
    ]
    command += ["-addext", "subjectAltName=DNS:localhost", "-keyout", str(key), "-out", str(chain)]
    try:
        subprocess.run(command, check=True, capture_output=True)  # noqa: S603
    except FileNotFoundError:
        pytest.skip("needs openssl")
    return key, chain


def test_importing_the_client_loads_nothing_heavy() -> None:
    code = (
        "import sys, cab_forecast; from cab_forecast import Client; Client('http://h').close();"
        "print(*{m.partition('.')[0] for m in sys.modules})"
    )
    run = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code], check=True, capture_output=True, text=True, env=dict(os.environ)
    )
    assert not {"torch", "matplotlib", "numpy", "PIL", "grpc", "model", "service"} & set(run.stdout.split())
