"""Users for Locust: ``locust -f loadtest/locustfile.py GrpcUser --host http://127.0.0.1:8080``.

A user is a vehicle that asks for forecasts of the agents around it at a steady rate (``--rate``). Locust
needs an environment with the ``loadtest`` extra. It replaces blocking calls by gevent's, which grpc does not
know by itself: the synchronous channel works after ``init_gevent``; grpc.aio, and so
``cab_forecast.AsyncClient``, does not.
"""

import time
from argparse import ArgumentParser
from typing import Any

import grpc
from gevent import get_hub
from grpc.experimental import gevent  # type: ignore[attr-defined]
from locust import HttpUser, User, constant_throughput, events, task

from cab.forecast.v1.prediction_service_pb2 import PredictResponse
from cab.forecast.v1.routes import PREDICT
from loadtest.requests import Encoding, Request, decode, made_up_requests

gevent.init_gevent()

_REQUESTS: dict[Encoding, list[Request]] = {}
"""Encoded requests, shared by all users of this process."""


@events.init_command_line_parser.add_listener  # type: ignore[untyped-decorator]
def add_options(parser: ArgumentParser) -> None:
    """Add the options of these users."""
    parser.add_argument("--model", default="cab", help="requested model")
    parser.add_argument("--agents", type=int, default=32, help="vehicles a call")
    parser.add_argument("--rate", type=float, default=2.0, help="calls/s of each user")
    parser.add_argument("--grpc", default="127.0.0.1:50051", help="HOST:PORT of gRPC")
    parser.add_argument("--timeout", type=float, default=1.0, help="deadline of a call, s")


@events.init.add_listener  # type: ignore[untyped-decorator]
def make_requests(environment: Any, **_: object) -> None:
    """Make the requests before the run begins."""
    options = environment.parsed_options
    for encoding in Encoding:
        _REQUESTS[encoding] = made_up_requests(options.model, options.agents, encoding)
    # The loop's clock has stood since before the imports; a run would end by that much too early
    get_hub().loop.update_now()


class _Vehicle:
    """Behaviour of all users: the rate, and the requests in turn."""

    environment: Any
    encoding: Encoding
    _calls = 0

    def wait_time(self) -> float:
        """Return the seconds until the next call."""
        seconds: float = constant_throughput(self.environment.parsed_options.rate)(self)
        return seconds

    def next_body(self) -> bytes:
        """Return the body of the next request."""
        requests = _REQUESTS[self.encoding]
        self._calls += 1
        return requests[self._calls % len(requests)].body

    def fault(self, answer: PredictResponse) -> str:
        """Return what is wrong with an answer; empty: nothing."""
        made, agents = len(answer.forecasts), self.environment.parsed_options.agents
        return "" if made == agents else f"{made} forecasts for {agents} agents"


class GrpcUser(_Vehicle, User):  # type: ignore[misc]
    """Vehicle that calls over gRPC."""

    encoding = Encoding.PROTOBUF

    def on_start(self) -> None:
        """Open a channel of its own, as a vehicle does."""
        options = [("grpc.use_local_subchannel_pool", 1), ("grpc.max_receive_message_length", -1)]
        self._channel = grpc.insecure_channel(self.environment.parsed_options.grpc, options)
        self._method = self._channel.unary_unary(
            PREDICT.rpc, None, response_deserializer=PredictResponse.FromString
        )

    def on_stop(self) -> None:
        """Close the channel."""
        self._channel.close()

    @task  # type: ignore[untyped-decorator]
    def predict(self) -> None:
        """Call once, and tell Locust what came of it."""
        body, begin = self.next_body(), time.perf_counter()
        answer, failure = PredictResponse(), None
        try:
            answer = self._method(body, timeout=self.environment.parsed_options.timeout)
        except grpc.RpcError as error:
            failure = RuntimeError(error.code().name)
        seconds = time.perf_counter() - begin
        if failure is None and (fault := self.fault(answer)):
            failure = RuntimeError(fault)
        self.environment.events.request.fire(
            request_type="gRPC",
            name="Predict",
            response_time=1000 * seconds,
            response_length=answer.ByteSize(),
            exception=failure,
            context={},
        )


class RestUser(_Vehicle, HttpUser):  # type: ignore[misc]
    """Vehicle that calls over REST with protobuf bodies."""

    encoding = Encoding.PROTOBUF

    @task  # type: ignore[untyped-decorator]
    def predict(self) -> None:
        """Call once; Locust takes the time by itself."""
        kind = self.encoding.media_type
        timeout = self.environment.parsed_options.timeout
        headers = {"Content-Type": kind, "Accept": kind, "Request-Timeout": f"{timeout:g}"}
        name = f"Predict, {self.encoding.value}"
        with self.client.post(
            PREDICT.path, self.next_body(), name=name, headers=headers, catch_response=True
        ) as response:
            if response.status_code != 200:
                response.failure(f"HTTP {response.status_code}")
            elif fault := self.fault(decode(response.content, self.encoding)):
                response.failure(fault)


class JsonUser(RestUser):
    """Vehicle that calls over REST with JSON."""

    encoding = Encoding.JSON
