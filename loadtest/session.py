"""A measured server, its clients and the results so far: what all scenarios of a load test share."""

import asyncio
import math
import time
from collections.abc import AsyncIterator, Coroutine
from contextlib import ExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from loadtest.generator import Calls, Generator, Load, even, poisson
from loadtest.redis_servers import HOST, free_port
from loadtest.requests import Encoding, ForwardInProcess, Map, Request, made_up_requests
from loadtest.results import Observer, Result
from loadtest.servers import Server, serving
from loadtest.wire import Transport, Wire, connect
from model.arrays import Floats

CLIENTS = 16
"""Clients of the closed loop that measures the peak."""
FEW_CLIENTS = (1, 2, 4, 8)
"""Clients of further closed loops for the peak of a short deadline, which many clients would miss."""
SHORT_DEADLINE = 0.5
"""s"""

_NORMAL_CALLS = 3
"""Number of successive calls that must be fast again."""
_NORMAL_FACTOR = 1.5
_NORMAL_SLACK = 0.005
"""A call is as fast as before up to this factor of the usual p90, and so many seconds."""
_WATCH_PERIOD = 0.5
"""Seconds between looks at the server's memory."""
_MAX_RECOVERY = 10.0
"""Seconds after which it is given up to wait for fast calls."""


@dataclass(frozen=True)
class Options:
    """Options of a load test."""

    models: Path
    """Folder of the server's checkpoints."""
    model: str = "cab"
    agents: int = 32
    seconds: float = 30.0
    """Duration of a run."""
    rate: float | None = None
    """Offered calls/s; None: the scenario's share of the peak."""
    peak: float | None = None
    """Peak, calls/s; None: measured."""
    peak_seconds: float = 5.0
    """Seconds of each measurement of the peak."""
    warm_up: float = 1.0
    """Seconds of calls before the first run, by many clients and by one."""
    deadline: float | None = None
    """Seconds from the scheduled time; None: the scenario's."""
    transport: Transport = Transport.GRPC
    encoding: Encoding = Encoding.PROTOBUF
    """Encoding of the bodies; gRPC has protobuf only."""
    map: Map = Map.RASTER
    """Form of the map in the bodies."""
    poisson: bool = True
    """Switch for calls at random times; False: at even intervals."""
    grpc: str | None = None
    """HOST:PORT of a running server's gRPC; None: a server is started."""
    http: str | None = None
    """HOST:PORT of a running server's REST."""
    uploads: int = 300
    """Number of slow uploads."""
    half_headers: int = 1000
    """Number of connections that never end their headers."""
    readers: int = 100
    """Number of clients that never read their responses."""
    max_probe_seconds: float = 1.0
    """Max time of a probe beside slow uploads."""
    max_slowdown: float = 2.5
    """Max ratio of the p50 beside a busy neighbour to the quiet one."""
    retry_seconds: float = 10.0
    """Seconds for which clients retry while the server restarts."""
    settings: dict[str, str] = field(default_factory=dict)
    """Settings of the started server."""


class Session:
    """A server under test, see ``opened``."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.results: list[Result] = []
        self.notes: list[str] = []
        """Figures of the whole session."""
        self._stack = ExitStack()
        self._server: Server | None = None
        self._grpc = options.grpc or f"{HOST}:{free_port()}"
        self._http = options.http or f"{HOST}:{free_port()}"
        self._usual = 0.0
        self.requests: list[Request] = made_up_requests(
            options.model, options.agents, options.encoding, options.map
        )
        self.forward = ForwardInProcess(options.models, options.model, self.requests)

    @property
    def http(self) -> str:
        """HOST:PORT of the server's REST."""
        return self._http

    @property
    def observer(self) -> Observer:
        """View of the server's resources."""
        return Observer(self._http, self._server.process.pid if self._server else None)

    @property
    def grpc(self) -> str:
        """HOST:PORT of the server's gRPC."""
        return self._grpc

    @property
    def owns_server(self) -> bool:
        """True if this session started the server."""
        return self.options.grpc is None and self.options.http is None

    async def open(self) -> None:
        """Start the server if necessary, connect, and warm up."""
        if self.owns_server:
            await self._start()
        address = self._grpc if self.options.transport is Transport.GRPC else self._http
        self.wire: Wire = connect(self.options.transport, address, self.options.encoding)
        self.generator = Generator(self.wire, self.requests)
        await self.generator.closed_loop(CLIENTS, self.options.warm_up)
        alone = await self.generator.closed_loop(1, self.options.warm_up)
        self._usual = float(np.quantile([call.seconds for call in alone.all], 0.9))

    async def close(self) -> None:
        """Disconnect, and stop the server if this session started it."""
        if hasattr(self, "wire"):
            await self.wire.close()
        await asyncio.to_thread(self._stack.close)

    async def restart(self) -> None:
        """Stop the server with SIGTERM, and start another one on the same ports.

        Raises:
            RuntimeError: the server was not started by this session.
        """
        if not self.owns_server:
            raise RuntimeError("only a server that the load test has started can be restarted")
        await asyncio.to_thread(self._stack.close)
        await self._start()

    def arrivals(self, rate: float, seconds: float, start: float = 0.0) -> Floats:
        """Return the times of calls at a rate."""
        return (poisson if self.options.poisson else even)(rate, seconds, start)

    async def peak(self, deadline: float | None = None) -> float:
        """Return the peak, calls/s: measured by a closed loop unless it is given.

        Args:
            deadline: s; for a short one the peak is the best rate of answers in time, over several numbers of
                clients.
        """
        if self.options.peak is not None:
            return self.options.peak
        short = deadline is not None and deadline < SHORT_DEADLINE
        numbers = (*FEW_CLIENTS, CLIENTS) if short else (CLIENTS,)
        limit = deadline if deadline is not None and short else math.inf
        rates = []
        for clients in numbers:
            calls = await self.generator.closed_loop(
                clients, self.options.peak_seconds / math.sqrt(len(numbers))
            )
            in_time = sum(call.code == "OK" and call.seconds <= limit for call in calls.all)
            rates.append(in_time / calls.seconds)
        return max(rates)

    async def open_loop(self, name: str, load: Load, peak: float = 0.0) -> Result:
        """Run a load and add its result.

        Args:
            name: name of the run.
            load: the load.
            peak: calls/s of the closed loop; 0: not measured.
        """
        return await self.measure(name, self.generator.open_loop(load), peak)

    async def measure(self, name: str, run: Coroutine[None, None, Calls], peak: float = 0.0) -> Result:
        """Run anything that calls, compare a sample of its answers with the forward, and add its result."""
        before = await asyncio.to_thread(self.observer.usage)
        resident: list[float] = []
        watching = asyncio.create_task(self._watch(resident))
        try:
            calls = await run
        finally:
            watching.cancel()
        after = await asyncio.to_thread(self.observer.usage)
        result = Result(name, calls, before, after, peak, resident)
        await asyncio.to_thread(self._check, result)
        self.results.append(result)
        return result

    async def recover(self, result: Result) -> None:
        """Call until calls are as fast as before the result's run, and note how long that takes."""
        begin, limit = time.perf_counter(), _NORMAL_FACTOR * self._usual + _NORMAL_SLACK
        normal, since = 0, begin
        while normal < _NORMAL_CALLS:
            if time.perf_counter() - begin > _MAX_RECOVERY:
                result.normal_after = math.inf
                return
            since = time.perf_counter() if normal == 0 else since
            [call] = (await self.generator.closed_loop(1, 0)).all
            normal = normal + 1 if call.code == "OK" and call.seconds <= limit else 0
        result.normal_after = since - begin

    async def raw_rate(self, seconds: float) -> float:
        """Return the best rate of the raw forward in this process, calls/s; the server must be idle."""
        settings = self.options.settings
        threads = int(settings["threads"]) if "threads" in settings else None
        rate = await asyncio.to_thread(
            self.forward.best_rate, settings.get("engine", "onnxruntime"), threads, seconds
        )
        return rate / self.options.agents

    async def _watch(self, resident: list[float]) -> None:
        """Note the server's memory again and again."""
        while True:
            with suppress(psutil.NoSuchProcess):  # it is being restarted
                resident.append(self.observer.resident())
            await asyncio.sleep(_WATCH_PERIOD)

    def _check(self, result: Result) -> None:
        sample = [call for call in result.calls.all if call.body]
        faults = (self.forward.fault(call.request, call.body, self.options.encoding) for call in sample)
        result.checked = len(sample)
        result.wrong = [fault for fault in faults if fault]
        for call in sample:
            call.body = b""

    async def _start(self) -> None:
        context = serving(self.options.models, self._http, self._grpc, **self.options.settings)
        self._server = await asyncio.to_thread(self._stack.enter_context, context)


@asynccontextmanager
async def opened(options: Options) -> AsyncIterator[Session]:
    """Open a session for the time of a block."""
    session = Session(options)
    try:
        await session.open()
        yield session
    finally:
        await session.close()
