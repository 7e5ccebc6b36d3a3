"""Cost of tracing: ``python -m loadtest.tracing``.

Two servers get the same calls in random order, so that other load on the machine affects both equally. One of
them traces each call and sends the spans to a collector in this process.
"""

import os
import random
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, NamedTuple

import grpc
import psutil
import typer
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2 as pb
from opentelemetry.proto.collector.trace.v1 import trace_service_pb2_grpc as rpc
from rich.console import Console
from rich.table import Table

from cab_forecast import Client, predict_request
from loadtest.paired_latency import AGENTS, STATES, Latencies
from loadtest.servers import Server, random_checkpoint, serving
from loadtest.traffic import START, STEP, Traffic

_WARM_UP = 20


class Collector(rpc.TraceServiceServicer):
    """Collector that counts spans and drops them."""

    def __init__(self) -> None:
        self.spans = 0

    def Export(  # noqa: N802 - the name of the method in OTLP
        self, request: pb.ExportTraceServiceRequest, context: grpc.ServicerContext
    ) -> pb.ExportTraceServiceResponse:
        """Count the spans of an export."""
        scopes = (scope for resource in request.resource_spans for scope in resource.scope_spans)
        self.spans += sum(len(scope.spans) for scope in scopes)
        return pb.ExportTraceServiceResponse()


class Cost(NamedTuple):
    """Cost of the calls to one server."""

    latencies: Latencies
    cpu_ms: float
    """CPU time of the process for a call."""


@contextmanager
def collecting() -> Iterator[Collector]:
    """Run a collector, to which servers that are started meanwhile send their spans."""
    collector = Collector()
    server = grpc.server(ThreadPoolExecutor(1))
    rpc.add_TraceServiceServicer_to_server(collector, server)  # type: ignore[no-untyped-call]
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    os.environ["OTEL_EXPORTER_OTLP_ENDPOINT"] = f"http://127.0.0.1:{port}"
    try:
        yield collector
    finally:
        del os.environ["OTEL_EXPORTER_OTLP_ENDPOINT"]
        server.stop(1).wait()


def measure(servers: dict[str, Server], model: str, rounds: int) -> dict[str, Cost]:
    """Return the cost of calls of ``AGENTS`` vehicles by server.

    Args:
        servers: the servers by name.
        model: the requested model.
        rounds: calls to each.
    """
    clients = {name: Client(f"grpc://{server.grpc}") for name, server in servers.items()}
    traffic, order = Traffic(AGENTS), random.Random(0)  # noqa: S311 - for the order
    latencies = {name: Latencies() for name in servers}
    before: dict[str, float] = {}
    for number in range(_WARM_UP + rounds):
        if number == _WARM_UP:
            before = {name: _cpu_seconds(server) for name, server in servers.items()}
            latencies = {name: Latencies() for name in servers}
        now = START + STEP * number
        request = predict_request(now, traffic.agents(now, STATES), model=model, merge=False)
        for name in order.sample(sorted(clients), len(clients)):
            begin = time.perf_counter()
            clients[name].predict(request)
            latencies[name].seconds.append(time.perf_counter() - begin)
    spent = {name: _cpu_seconds(server) - before[name] for name, server in servers.items()}
    for client in clients.values():
        client.close()
    return {name: Cost(latencies[name], 1e3 * spent[name] / rounds) for name in servers}


def _cpu_seconds(server: Server) -> float:
    times = psutil.Process(server.process.pid).cpu_times()
    return float(times.user + times.system)


def main(
    rounds: Annotated[int, typer.Option(min=2, help="calls to each server")] = 400,
) -> None:
    """Print what tracing adds to the latency and the CPU time of a call."""
    table = Table(title=f"calls of {AGENTS} vehicles, each traced")
    for heading in ("model", "p50 without, ms", "added p50, ms (95 %)", "CPU without, ms", "added, ms"):
        table.add_column(heading)
    with tempfile.TemporaryDirectory() as folder, collecting() as collector:
        models = Path(folder)
        random_checkpoint(models)
        with serving(models) as plain, serving(models, tracing=True) as traced:
            for model in ("kalman", "cab"):
                cost = measure({"plain": plain, "traced": traced}, model, rounds)
                off, on = cost["plain"], cost["traced"]
                added = on.latencies.added_to(off.latencies)
                table.add_row(
                    model,
                    f"{off.latencies.quantile_ms(0.5):.2f}",
                    f"{added.median:+.2f} ({added.low:+.2f} … {added.high:+.2f})",
                    f"{off.cpu_ms:.2f}",
                    f"{on.cpu_ms - off.cpu_ms:+.2f}",
                )
    Console(width=110).print(table, f"{collector.spans} spans arrived")
    if not collector.spans:
        raise typer.Exit(1)


if __name__ == "__main__":
    typer.run(main)
