"""Redis servers on free local ports, and a proxy that injects network faults."""

import asyncio
import random
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

HOST = "127.0.0.1"
MASTER_NAME = "tracks"
"""Name of the master in the Sentinels."""

_PORTS = (20000, 22767)
"""Range below the ephemeral ports, also with the 10000 that cluster nodes add for their bus."""
_BUS = 10000
_ATTEMPTS = 20
_START_SECONDS = 20.0
"""Start timeout; a server is up in milliseconds, unless the machine is very busy."""
_NODE_TIMEOUT = 1000
"""Milliseconds after which a cluster node or a master counts as failed."""


@dataclass
class Process:
    """A redis-server process."""

    port: int
    folder: Path
    process: "subprocess.Popen[bytes]"
    password: str | None = field(default=None, repr=False)

    @property
    def url(self) -> str:
        """URL of this server."""
        return f"redis://{f':{self.password}@' if self.password else ''}{HOST}:{self.port}"

    def command(self, *words: str | int) -> object:
        """Run a command over a new connection and return the raw reply.

        Raises:
            redis.RedisError: the server does not answer, or answers with an error.
        """
        with redis.Redis(
            HOST, self.port, password=self.password, socket_timeout=5, protocol=2, retry=Retry(NoBackoff(), 0)
        ) as client:
            client.response_callbacks.clear()  # raw replies
            return client.execute_command(*words)

    def text(self, *words: str | int) -> str:
        """Run a command and return its text reply.

        Raises:
            TypeError: the reply is not a text.
        """
        reply = self.command(*words)
        if not isinstance(reply, bytes):
            raise TypeError(f"the reply is not a text: {reply!r}")
        return reply.decode()

    def pause(self) -> None:
        """Make the server hang: the system accepts connections, but nothing is answered."""
        self.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """Continue after ``pause``."""
        self.process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """Kill the server."""
        self.process.kill()
        self.process.wait()

    def stop(self) -> None:
        """Stop the server."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
            try:
                self.process.wait(10)
            except subprocess.TimeoutExpired:
                self.kill()


@dataclass(frozen=True)
class Cluster:
    """Three masters with a replica each."""

    nodes: Sequence[Process]

    @property
    def url(self) -> str:
        """URL of the cluster, with its first nodes."""
        return f"redis+cluster://{','.join(f'{HOST}:{node.port}' for node in self.nodes[:3])}"


@dataclass(frozen=True)
class Sentinels:
    """A master, its replica and three Sentinels that watch them."""

    master: Process
    replica: Process
    sentinels: Sequence[Process]

    @property
    def url(self) -> str:
        """URL of the master, with the Sentinels."""
        hosts = ",".join(f"{HOST}:{sentinel.port}" for sentinel in self.sentinels)
        return f"redis+sentinel://{hosts}/{MASTER_NAME}"


@contextmanager
def single(*options: str, password: str | None = None) -> Iterator[Process]:
    """Run one server.

    Args:
        options: further command line options, such as "--maxmemory", "8mb".
        password: password of the default user; None: no password.

    Raises:
        FileNotFoundError: Redis is not installed.
    """
    with ExitStack() as stack:
        yield _start(stack, *options, password=password)


@contextmanager
def cluster() -> Iterator[Cluster]:
    """Run three masters with a replica each."""
    with ExitStack() as stack:
        options = ["--cluster-enabled", "yes", "--cluster-node-timeout", str(_NODE_TIMEOUT)]
        nodes = [_start(stack, *options, bus=True) for _ in range(6)]
        hosts = [f"{HOST}:{node.port}" for node in nodes]
        create = ["--cluster", "create", *hosts, "--cluster-replicas", "1", "--cluster-yes"]
        subprocess.run([_program("redis-cli"), *create], check=True, capture_output=True, timeout=60)  # noqa: S603
        until(lambda: all(_joined(node) for node in nodes))
        yield Cluster(nodes)


@contextmanager
def sentinels() -> Iterator[Sentinels]:
    """Run a master, its replica and three Sentinels that watch them."""
    with ExitStack() as stack:
        master = _start(stack)
        replica = _start(stack, "--replicaof", f"{HOST} {master.port}")
        until(lambda: "master_link_status:up" in replica.text("INFO"))
        watchers = [_start(stack, sentinel_of=master) for _ in range(3)]
        # There is no failover before they know each other and the replica
        until(lambda: all(_knows_all(watcher) for watcher in watchers))
        yield Sentinels(master, replica, watchers)


def until(true: Callable[[], bool], seconds: float = 30.0) -> None:
    """Wait until a condition is true; Redis errors count as false.

    Raises:
        TimeoutError: the condition is still false after that time.
    """
    give_up = time.monotonic() + seconds
    while time.monotonic() < give_up:
        with suppress(redis.RedisError):
            if true():
                return
        time.sleep(0.02)
    raise TimeoutError


def free_port(bus: bool = False) -> int:
    """Return a free port.

    Args:
        bus: whether the bus port of a cluster node there must be free too.
    """
    for _ in range(_ATTEMPTS):
        port = random.randint(*_PORTS)  # noqa: S311
        if _is_free(port) and (not bus or _is_free(port + _BUS)):
            return port
    raise RuntimeError("no free port found")


Mode = Literal["pass", "slow", "stall", "close"]
"""Treatment of the traffic: pass it, delay it, hold it until the mode changes, or close all connections."""


class FaultProxy:
    """TCP proxy with injected faults, in its own thread."""

    def __init__(self, port: int) -> None:
        """
        Args:
            port: port of the server behind it.
        """
        self._target = port
        self._mode: Mode = "pass"
        self._delay: tuple[float, float] = (0.0, 0.0)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="fault-proxy")
        self._changed = asyncio.Event()
        self._connections: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None
        self.port = 0
        """Port of the proxy."""
        self.accepted = 0
        """Number of connections accepted so far."""
        self.max_connections = 0
        """Highest number of concurrent connections."""

    @property
    def url(self) -> str:
        """URL of the server through the proxy."""
        return f"redis://{HOST}:{self.port}"

    def set(self, mode: Mode, delay: float | tuple[float, float] = 0.0) -> None:
        """Set the treatment of the traffic.

        Args:
            mode: treatment of all connections, in both directions.
            delay: seconds of delay in each direction for "slow", or the two bounds of a random delay.
        """
        bounds = delay if isinstance(delay, tuple) else (delay, delay)
        self._do(self._set(mode, bounds))

    def __enter__(self) -> Self:
        self._thread.start()
        self._do(self._open())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._do(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def _do(self, what: Coroutine[None, None, None]) -> None:
        asyncio.run_coroutine_threadsafe(what, self._loop).result(10)

    async def _open(self) -> None:
        self._server = await asyncio.start_server(self._accept, HOST, 0)
        self.port = self._server.sockets[0].getsockname()[1]

    async def _close(self) -> None:
        if self._server is not None:
            self._server.close()
        await self._drop()

    async def _set(self, mode: Mode, delay: tuple[float, float]) -> None:
        self._mode, self._delay = mode, delay
        self._changed.set()
        self._changed = asyncio.Event()
        if mode == "close":
            await self._drop()

    async def _drop(self) -> None:
        connections = tuple(self._connections)
        for connection in connections:
            connection.cancel()
        await asyncio.gather(*connections, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.accepted += 1
        connection = asyncio.current_task()
        if connection is None:
            raise RuntimeError("not in a task")
        self._connections.add(connection)
        self.max_connections = max(self.max_connections, len(self._connections))
        server: asyncio.StreamWriter | None = None
        try:
            if self._mode == "close":
                return
            there, server = await asyncio.open_connection(HOST, self._target)
            pumps = [
                asyncio.create_task(self._pump(reader, server)),
                asyncio.create_task(self._pump(there, writer)),
            ]
            try:
                await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for pump in pumps:
                    pump.cancel()
                await asyncio.gather(*pumps, return_exceptions=True)
        except (OSError, asyncio.CancelledError):
            pass  # only this class cancels the task
        finally:
            self._connections.discard(connection)
            for end in (writer, server):
                if end is not None:
                    end.close()
                    with suppress(OSError):
                        await end.wait_closed()

    async def _pump(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            while data := await reader.read(2**16):
                if self._mode == "slow":
                    await asyncio.sleep(random.uniform(*self._delay))  # noqa: S311
                while self._mode == "stall":
                    await self._changed.wait()
                writer.write(data)
                await writer.drain()


def _start(
    stack: ExitStack,
    *options: str,
    password: str | None = None,
    bus: bool = False,
    sentinel_of: Process | None = None,
) -> Process:
    """Start a server that stops with the stack."""
    program = _program("redis-server")
    for _ in range(_ATTEMPTS):  # another process may take the port first
        port = free_port(bus)
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="redis-test-")))
        words = ["--port", str(port), "--bind", HOST, "--dir", str(folder), "--loglevel", "warning"]
        if sentinel_of is None:
            words += ["--save", "", "--appendonly", "no", "--repl-diskless-sync-delay", "0", *options]
            if password is not None:
                words += ["--requirepass", password]
        else:
            config = folder / "sentinel.conf"
            config.write_text(
                f"sentinel monitor {MASTER_NAME} {HOST} {sentinel_of.port} 2\n"
                f"sentinel down-after-milliseconds {MASTER_NAME} {_NODE_TIMEOUT}\n"
                f"sentinel failover-timeout {MASTER_NAME} 5000\n"
            )
            words = [str(config), "--sentinel", *words]
        log = stack.enter_context((folder / "log").open("wb"))
        process = subprocess.Popen([program, *words], stdin=subprocess.DEVNULL, stdout=log, stderr=log)  # noqa: S603
        server = Process(port, folder, process, password)
        stack.callback(server.stop)
        if _is_up(server):
            return server
    raise RuntimeError(f"no redis-server started: {(folder / 'log').read_text()}")


def _is_up(server: Process) -> bool:
    """Wait until the server answers or has ended, and return whether it answers."""
    give_up = time.monotonic() + _START_SECONDS
    while time.monotonic() < give_up and server.process.poll() is None:
        with suppress(redis.RedisError):
            server.command("PING")
            return server.process.poll() is None
        time.sleep(0.01)
    return False


def _is_free(port: int) -> bool:
    with socket.socket() as taken:
        try:
            taken.bind((HOST, port))
        except OSError:
            return False
    return True


def _program(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        raise FileNotFoundError(f"{name} is not installed")
    return found


def _joined(node: Process) -> bool:
    """Return whether a cluster node sees a healthy cluster."""
    return "cluster_state:ok" in node.text("CLUSTER INFO") and node.text("CLUSTER NODES").count("slave") == 3


def _knows_all(watcher: Process) -> bool:
    """Return whether a Sentinel knows the replica and both other Sentinels."""
    info = watcher.text("INFO")
    return "status=ok" in info and "slaves=1,sentinels=3" in info
