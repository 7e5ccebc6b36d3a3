"""Scenarios of load tests: each is a function that runs loads in a session."""

import asyncio
import math
import resource
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterable, Iterator, Mapping
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np

from cab.forecast.v1.routes import PREDICT
from loadtest.generator import Calls, Load
from loadtest.requests import Encoding, encode
from loadtest.results import Result
from loadtest.session import CLIENTS, Session
from loadtest.wire import read_head

Scenario = Callable[[Session], Awaitable[None]]

OVERLOAD = 3.0
"""Offered rate of an overload, relative to the peak."""
DEADLINES = (0.1, 1.0, None)
"""Deadlines of the overload, s."""
USUAL_DEADLINE = 1.0
"""Deadline of the other scenarios, s."""

_UPLOAD_BYTES = 15_000_000
_UPLOAD_PIECE = 2**16
_MEBIBYTE = 2**20
_PIECE_SECONDS = 1.0
"""Seconds between the pieces of an upload."""
_PROBE_PERIOD = 0.2
_PROBE_TIMEOUT = 10.0


async def closed(session: Session) -> None:
    """Measure 1 and 16 clients in a closed loop, and their rate relative to the raw forward's best.

    The raw forward is measured before and after, and the better rate counts.
    """
    seconds = session.options.seconds
    raw = [await session.raw_rate(session.options.peak_seconds / 2)]
    for clients in (1, CLIENTS):
        run = session.generator.closed_loop(clients, seconds)
        await session.measure(f"{clients} clients" if clients > 1 else "1 client", run)
    raw.append(await session.raw_rate(session.options.peak_seconds / 2))
    best = max(raw)
    for result in session.results[-2:]:
        result.peak = best
        result.notes.append("ratio: to the raw forward's best batch rate")
    session.notes.append(
        f"raw forward: {best:.1f} calls/s = {best * session.options.agents:.0f} agents/s (before and after: "
        f"{raw[0]:.1f}, {raw[1]:.1f})"
    )


async def steady(session: Session) -> None:
    """Offer half the peak."""
    await _constant(session, "steady", 0.5)


async def soak(session: Session) -> None:
    """Offer half the peak for long, and look for growing memory, files and threads."""
    result = await _constant(session, "soak", 0.5)
    before, after = result.before, result.after
    result.notes.append(f"threads {before.threads} → {after.threads}, files {before.files} → {after.files}")
    growth = after.resident / before.resident - 1
    result.notes.append(f"memory {100 * growth:+.2f} %")


async def ramp(session: Session) -> None:
    """Offer more and more, from a fifth of the peak to 1.4 times the peak."""
    options, peak = session.options, await session.peak()
    shares = (0.2, 0.4, 0.6, 0.8, 0.9, 1.0, 1.2, 1.4)
    for share in shares:
        seconds = options.seconds / len(shares)
        load = Load(session.arrivals(share * (options.rate or peak), seconds), seconds, _deadline(session))
        await session.open_loop(f"ramp {share:g} ×", load, peak)
    await session.recover(session.results[-1])


async def spike(session: Session) -> None:
    """Offer little, then three times the peak for a sixth of the time, then little again."""
    options, peak = session.options, await session.peak()
    for name, share, part in (("before", 0.3, 0.42), ("spike", OVERLOAD, 0.16), ("after", 0.3, 0.42)):
        seconds = part * options.seconds
        load = Load(session.arrivals(share * peak, seconds), seconds, _deadline(session))
        result = await session.open_loop(f"spike: {name}" if name != "spike" else name, load, peak)
        if name == "spike":
            await session.recover(result)


async def overload(session: Session) -> None:
    """Offer three times the peak, with a short deadline, a long one and none.

    The peak is that of the deadline, and measured again after each run; the mean of the two counts.
    """
    options = session.options
    for deadline in DEADLINES if options.deadline is None else (options.deadline,):
        peak = await session.peak(deadline)
        rate = options.rate or OVERLOAD * peak
        load = Load(session.arrivals(rate, options.seconds), options.seconds, deadline)
        text = "no deadline" if deadline is None else f"deadline {1000 * deadline:g} ms"
        result = await session.open_loop(f"overload, {text}", load, peak)
        result.notes.append(_memory(result))
        await session.recover(result)
        result.peak = (peak + await session.peak(deadline)) / 2


async def neighbour(session: Session) -> None:
    """Call with one client, first alone and then beside a process that takes one core."""
    seconds = session.options.seconds / 2
    quiet = await session.measure("quiet", session.generator.closed_loop(1, seconds))
    with _busy_core():
        busy = await session.measure("busy neighbour", session.generator.closed_loop(1, seconds))
    slowdown = busy.latency(0.5) / quiet.latency(0.5)
    busy.notes.append(f"p50 {slowdown:.2f} × the quiet one")
    if slowdown > session.options.max_slowdown:
        busy.problems.append(f"p50 is more than {session.options.max_slowdown:g} × the quiet one")


async def slow_readers(session: Session) -> None:
    """Call while many clients send requests over REST and never read the responses."""
    options, peak = session.options, await session.peak()
    load = Load(
        session.arrivals(options.rate or 0.4 * peak, options.seconds), options.seconds, _deadline(session)
    )
    body = encode(session.requests[0].message, Encoding.PROTOBUF)
    async with _beside(_never_read(session.http, body) for _ in range(options.readers)):
        result = await session.open_loop("slow readers", load, peak)
    result.notes.append(f"{options.readers} clients that do not read; {_memory(result)}")
    await session.recover(result)


@asynccontextmanager
async def _beside(clients: Iterable[Coroutine[Any, Any, None]]) -> AsyncIterator[None]:
    """Run clients for the time of a block, and cancel them after it."""
    tasks = [asyncio.create_task(client) for client in clients]
    try:
        yield
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def cancelled(session: Session) -> None:
    """Cancel three of ten calls at a random time; the rest must be answered."""
    options, peak = session.options, await session.peak()
    rate = options.rate or 0.8 * peak
    load = Load(session.arrivals(rate, options.seconds), options.seconds, _deadline(session), cancelled=0.3)
    result = await session.open_loop("cancelled", load, peak)
    await session.recover(result)
    queued = (await asyncio.to_thread(session.observer.usage)).queued
    if queued:
        result.problems.append(f"{queued:g} agents are left in the queue")


async def restart(session: Session) -> None:
    """Restart the server while clients call, who retry for some seconds."""
    options, peak = session.options, await session.peak()
    load = Load(
        session.arrivals(options.rate or 0.3 * peak, options.seconds),
        options.seconds,
        _deadline(session),
        retry_for=options.retry_seconds,
    )

    ready_after = 0.0

    async def run_and_restart() -> Calls:
        nonlocal ready_after
        running = asyncio.create_task(session.generator.open_loop(load))
        await asyncio.sleep(options.seconds / 3)
        begin = time.perf_counter()
        await session.restart()
        ready_after = time.perf_counter() - begin
        return await running

    result = await session.measure("restart", run_and_restart(), peak)
    # The counts of the new server began at 0
    result.before = replace(result.after, time=result.after.time - result.calls.seconds, cpu=0.0, refused={})
    result.notes.append(f"a new server was ready {ready_after:.1f} s after SIGTERM")
    await session.recover(result)


async def slow_uploads(session: Session) -> None:
    """Call while many clients upload requests slowly or never end their headers, and look at the probes."""
    options, peak = session.options, await session.peak()
    load = Load(
        session.arrivals(options.rate or 0.4 * peak, options.seconds), options.seconds, _deadline(session)
    )
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    probes: list[float] = []
    clients = [
        _probe(session.http, probes),
        *(_upload(session.http) for _ in range(options.uploads)),
        *(_half_header(session.http) for _ in range(options.half_headers)),
    ]
    try:
        async with _beside(clients):
            result = await session.open_loop("slow uploads", load, peak)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    result.notes.append(
        f"{options.uploads} uploads of {_UPLOAD_BYTES / 1e6:g} MB, {options.half_headers} half headers; "
        f"slowest of {len(probes)} probes {max(probes, default=math.inf):.2f} s"
    )
    if not probes or max(probes) > options.max_probe_seconds:
        result.problems.append(f"a probe took longer than {options.max_probe_seconds:g} s")
    await session.recover(result)


SCENARIOS: Mapping[str, Scenario] = {
    "closed": closed,
    "steady": steady,
    "ramp": ramp,
    "spike": spike,
    "overload": overload,
    "cancelled": cancelled,
    "slow-uploads": slow_uploads,
    "slow-readers": slow_readers,
    "neighbour": neighbour,
    "restart": restart,
    "soak": soak,
}
"""Scenarios by name."""


def _deadline(session: Session) -> float:
    return session.options.deadline or USUAL_DEADLINE


def _memory(result: Result) -> str:
    """Return how much memory the server had in the second and the last third of the run, and at most."""
    third = len(result.resident) // 3
    if not third:
        return "memory: not observed"
    middle, last = (
        float(np.mean(part)) for part in (result.resident[third:-third], result.resident[-third:])
    )
    return (
        f"memory at most {max(result.resident) / _MEBIBYTE:.0f} MiB; "
        f"from the second to the last third {100 * (last / middle - 1):+.1f} %"
    )


async def _constant(session: Session, name: str, share: float) -> Result:
    """Offer a share of the peak at a constant rate."""
    options, peak = session.options, await session.peak()
    load = Load(
        session.arrivals(options.rate or share * peak, options.seconds), options.seconds, _deadline(session)
    )
    result = await session.open_loop(name, load, peak)
    await session.recover(result)
    return result


async def _upload(http: str) -> None:
    """Upload a request in small pieces, and another one when the server ends it."""
    pieces = _UPLOAD_BYTES // _UPLOAD_PIECE
    head = f"POST {PREDICT.path} HTTP/1.1\r\nHost: {http}\r\nContent-Type: application/x-protobuf\r\n"
    while True:
        with suppress(OSError):
            async with _connection(http) as (_, writer):
                writer.write(f"{head}Content-Length: {pieces * _UPLOAD_PIECE}\r\n\r\n".encode())
                for _ in range(pieces):
                    writer.write(bytes(_UPLOAD_PIECE))
                    await writer.drain()
                    await asyncio.sleep(_PIECE_SECONDS)
        await asyncio.sleep(_PIECE_SECONDS)


async def _never_read(http: str, body: bytes) -> None:
    """Send requests on one connection, as fast as the server takes them, and read nothing."""
    head = f"POST {PREDICT.path} HTTP/1.1\r\nHost: {http}\r\nContent-Type: application/x-protobuf\r\n"
    message = f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body
    while True:
        with suppress(OSError):
            async with _connection(http, limit=1) as (_, writer):
                while True:
                    writer.write(message)
                    await writer.drain()
                    await asyncio.sleep(_PIECE_SECONDS)
        await asyncio.sleep(_PIECE_SECONDS)


@contextmanager
def _busy_core() -> Iterator[None]:
    """Keep one core busy by another process during a block."""
    process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        yield
    finally:
        process.kill()
        process.wait()


async def _half_header(http: str) -> None:
    """Send the beginning of a request, again when the server closes the connection."""
    while True:
        with suppress(OSError):
            async with _connection(http) as (reader, writer):
                writer.write(f"POST {PREDICT.path} HTTP/1.1\r\nHost: ".encode())
                await reader.read()
        await asyncio.sleep(_PIECE_SECONDS)


async def _probe(http: str, seconds: list[float]) -> None:
    """Ask again and again whether the server is ready, and note how long that takes."""
    question = f"GET /readyz HTTP/1.1\r\nHost: {http}\r\nConnection: close\r\n\r\n".encode()
    while True:
        begin, status = time.perf_counter(), 0
        with suppress(OSError, EOFError, TimeoutError):
            async with asyncio.timeout(_PROBE_TIMEOUT), _connection(http) as (reader, writer):
                writer.write(question)
                status, _ = await read_head(reader)
        seconds.append(time.perf_counter() - begin if status == 200 else math.inf)
        await asyncio.sleep(_PROBE_PERIOD)


@asynccontextmanager
async def _connection(
    http: str, limit: int = 2**16
) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    """Open a connection for the time of a block.

    Args:
        http: HOST:PORT.
        limit: bytes beyond which the reader stops to receive.
    """
    host, _, port = http.rpartition(":")
    reader, writer = await asyncio.open_connection(host, int(port), limit=limit)
    try:
        yield reader, writer
    finally:
        writer.close()
