"""Comparison of our server with peers: closed loops against both in turns, in one run."""

import asyncio
import os
import platform
from collections.abc import Callable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from loadtest.generator import Calls, Generator
from loadtest.peers.catalog import PEERS, Peer
from loadtest.peers.network import ServedModel
from loadtest.peers.prepared import PreparedRequests
from loadtest.peers.processes import running
from loadtest.peers.report import Measured, Measurement, Take
from loadtest.redis_servers import free_port
from loadtest.requests import Encoding, ForwardInProcess, made_up_requests
from loadtest.servers import serving
from loadtest.wire import GrpcWire, Wire

ROUNDS = 2
"""Number of turns of each server in a measurement."""


@dataclass(frozen=True)
class Options:
    """Options of a comparison."""

    models: Path
    """Folder of checkpoints."""
    model: str = "cab"
    agents: Sequence[int] = (1, 8, 32)
    """Numbers of vehicles a call."""
    clients: Sequence[int] = (1, 16)
    """Numbers of clients."""
    seconds: float = 4.0
    """Seconds of each measurement."""
    warm_up: float = 1.0
    """Seconds of calls before the first measurement of a size, by the most clients."""
    engine: str = "onnxruntime"
    threads: int | None = None
    """Threads of a forward; None: all cores."""


class WrongAnswerError(Exception):
    """Answers that were lost or differ from the forward."""


@dataclass
class _Side:
    """One of the two servers in a measurement."""

    title: str
    generator: Generator
    request_bytes: int
    fault: Callable[[int, bytes], str]
    runs: list[Calls] = field(default_factory=list)
    checked: int = 0

    async def run(self, clients: int, seconds: float) -> None:
        """Call for some seconds and check a sample of the answers.

        Raises:
            WrongAnswerError: a call failed, or an answer differs from the forward.
        """
        calls = await self.generator.closed_loop(clients, seconds)
        self.runs.append(calls)
        failed = [call.code for call in calls.all if call.code != "OK"]
        if failed:
            raise WrongAnswerError(f"{self.title}: {len(failed)} calls failed, e.g. with {failed[0]}")
        sample = [call for call in calls.all if call.body]
        faults = [fault for call in sample if (fault := self.fault(call.request, call.body))]
        if faults:
            raise WrongAnswerError(f"{self.title}: {len(faults)} of {len(sample)} answers wrong: {faults[0]}")
        self.checked += len(sample)

    def measured(self) -> Measured:
        """Return the figures of all runs together."""
        latencies = [call.seconds for run in self.runs for call in run.all]
        seconds = sum(run.seconds for run in self.runs)
        return Measured(
            calls_per_second=len(latencies) / seconds,
            p50_ms=1e3 * float(np.quantile(latencies, 0.5)),
            p99_ms=1e3 * float(np.quantile(latencies, 0.99)),
            client_cpu=sum(run.cpu * run.seconds for run in self.runs) / seconds,
            answers_checked=self.checked,
            request_bytes=self.request_bytes,
        )


async def compare(name: str, options: Options) -> Take:
    """Return the measurements of one peer beside our server.

    Args:
        name: name of the peer.
        options: the options.

    Raises:
        LookupError: the peer's package is not installed.
        RuntimeError: a server did not start.
        WrongAnswerError: a call failed, or an answer differs from the forward.
    """
    sizes = {agents: _Size(options, agents, PEERS[name]) for agents in sorted(options.agents)}
    served = ServedModel(free_port(), options.models, options.model, options.engine, options.threads)
    settings: dict[str, Any] = {"engine": options.engine} | (
        {} if options.threads is None else {"threads": options.threads}
    )
    measurements: list[Measurement] = []
    load_before = os.getloadavg()[0]
    async with AsyncExitStack() as stack:
        server = await asyncio.to_thread(stack.enter_context, serving(options.models, **settings))
        wire = GrpcWire(server.grpc)
        stack.push_async_callback(wire.close)
        first = next(iter(sizes.values())).of_peer[0]
        peer_wire = await stack.enter_async_context(running(name, served, first.body))
        for size in sizes.values():
            measurements += await size.measure(wire, peer_wire)
        largest = sizes[max(sizes)].forward
        raw = await asyncio.to_thread(largest.best_rate, options.engine, options.threads, options.seconds / 4)
    peer = PEERS[name]
    return Take(
        name=name,
        title=peer.title,
        input="our request" if peer.codec is None else "tensors",
        batches=peer.batches,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        conditions=_conditions(options),
        load_before=load_before,
        raw_agents_per_second=raw,
        measurements=measurements,
    )


class _Size:
    """Requests of one size, for both servers."""

    def __init__(self, options: Options, agents: int, peer: Peer) -> None:
        self._options = options
        self._agents = agents
        self.ours = made_up_requests(options.model, agents)
        self.forward = ForwardInProcess(options.models, options.model, self.ours)
        self._title = peer.title
        if peer.codec is None:
            self.of_peer, self._fault = self.ours, self._fault_of_response
        else:
            codec = peer.codec(options.model)
            prepared = PreparedRequests(options.models, options.model, self.ours)
            self.of_peer = prepared.encoded(codec)
            self._fault = lambda index, body: prepared.fault(index, body, codec)

    async def measure(self, wire: Wire, peer_wire: Wire) -> list[Measurement]:
        """Return the measurements with each number of clients.

        Raises:
            WrongAnswerError: a call failed, or an answer differs from the forward.
        """
        options, measurements = self._options, []
        generators = Generator(wire, self.ours), Generator(peer_wire, self.of_peer)
        for generator in generators:
            await generator.closed_loop(max(options.clients), options.warm_up)
        for clients in options.clients:
            ours = _Side("our server", generators[0], len(self.ours[0].body), self._fault_of_response)
            peer = _Side(self._title, generators[1], len(self.of_peer[0].body), self._fault)
            for turn in range(ROUNDS):
                # Each server is the first in half of the turns
                for side in (ours, peer) if turn % 2 == 0 else (peer, ours):
                    await side.run(clients, options.seconds / ROUNDS)
            measurements.append(
                Measurement(agents=self._agents, clients=clients, peer=peer.measured(), ours=ours.measured())
            )
        return measurements

    def _fault_of_response(self, index: int, body: bytes) -> str:
        return self.forward.fault(index, body, Encoding.PROTOBUF)


def _conditions(options: Options) -> str:
    threads = "all cores" if options.threads is None else f"{options.threads} threads"
    return (
        f"{os.cpu_count()} cores ({platform.machine()}), {options.model} in {options.engine} with {threads}, "
        f"all modes; clients on the same machine, closed loop, {options.seconds:g} s each in {ROUNDS} turns"
    )
