"""Real Redis servers on free ports of this machine, and a network between them and us that can fail."""

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

import pytest
import redis
from redis.backoff import NoBackoff
from redis.retry import Retry

HOST = "127.0.0.1"
MASTER_NAME = "tracks"
"""By which the Sentinels know their master."""

_PORTS = (20000, 22767)
"""Below those that the system gives out by itself, and so are these + 10000, on which cluster nodes talk."""
_BUS = 10000
_ATTEMPTS = 20
_START_SECONDS = 20.0
"""A server is up in milliseconds, unless the machine is very busy."""
_NODE_TIMEOUT = 1000
"""ms after which a cluster node or a master is taken for dead."""


@dataclass
class Process:
    """One redis-server."""

    port: int
    folder: Path
    process: "subprocess.Popen[bytes]"
    password: str | None = field(default=None, repr=False)

    @property
    def url(self) -> str:
        """Address of this server."""
        return f"redis://{f':{self.password}@' if self.password else ''}{HOST}:{self.port}"

    def command(self, *words: str | int) -> object:
        """What it answers to a command, over a connection of its own.

        Raises:
            redis.RedisError: it does not answer, or with an error.
        """
        with redis.Redis(
            HOST, self.port, password=self.password, socket_timeout=5, protocol=2, retry=Retry(NoBackoff(), 0)
        ) as client:
            client.response_callbacks.clear()  # as it came
            return client.execute_command(*words)

    def text(self, *words: str | int) -> str:
        """The same for a command that is answered with a text."""
        answer = self.command(*words)
        assert isinstance(answer, bytes)
        return answer.decode()

    def pause(self) -> None:
        """It hangs: connections are taken by the system, but nothing is answered."""
        self.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        """It goes on."""
        self.process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """It is gone, without a word."""
        self.process.kill()
        self.process.wait()

    def stop(self) -> None:
        """It ends."""
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
        """Address of the cluster, by its first nodes."""
        return f"redis+cluster://{','.join(f'{HOST}:{node.port}' for node in self.nodes[:3])}"


@dataclass(frozen=True)
class Sentinels:
    """A master, its replica and three Sentinels that watch them."""

    master: Process
    replica: Process
    sentinels: Sequence[Process]

    @property
    def url(self) -> str:
        """Address of the master, by the Sentinels."""
        hosts = ",".join(f"{HOST}:{sentinel.port}" for sentinel in self.sentinels)
        return f"redis+sentinel://{hosts}/{MASTER_NAME}"


@contextmanager
def single(*options: str, password: str | None = None) -> Iterator[Process]:
    """One server.

    Args:
        options: more of them, as on its command line: "--maxmemory", "8mb".
        password: of its default user; None: none is asked for.
    """
    with ExitStack() as stack:
        yield _start(stack, *options, password=password)


@contextmanager
def cluster() -> Iterator[Cluster]:
    """Three masters with a replica each."""
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
    """A master, its replica and three Sentinels that watch them."""
    with ExitStack() as stack:
        master = _start(stack)
        replica = _start(stack, "--replicaof", f"{HOST} {master.port}")
        until(lambda: "master_link_status:up" in replica.text("INFO"))
        watchers = [_start(stack, sentinel_of=master) for _ in range(3)]
        # Before they know of each other and of the replica there is no failover.
        until(lambda: all(_knows_all(watcher) for watcher in watchers))
        yield Sentinels(master, replica, watchers)


def until(true: Callable[[], bool], seconds: float = 30.0) -> None:
    """Returns when something has become true; a server that does not answer (yet) counts as not.

    Raises:
        TimeoutError: it has not in that time.
    """
    give_up = time.monotonic() + seconds
    while time.monotonic() < give_up:
        with suppress(redis.RedisError):
            if true():
                return
        time.sleep(0.02)
    raise TimeoutError


def free_port(bus: bool = False) -> int:
    """A port that nobody listens on.

    Args:
        bus: nor on the one that a cluster node there would talk to others on.
    """
    for _ in range(_ATTEMPTS):
        port = random.randint(*_PORTS)
        if _is_free(port) and (not bus or _is_free(port + _BUS)):
            return port
    raise RuntimeError("no free port found")


Mode = Literal["pass", "slow", "stall", "close"]
"""What becomes of bytes: they pass, they pass late, they wait for another mode; or connections are closed,
new ones at once."""


class FaultProxy:
    """A TCP proxy that can be told to fail, in a thread of its own."""

    def __init__(self, port: int) -> None:
        """
        Args:
            port: of the server behind it.
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
        """Of the proxy."""
        self.accepted = 0
        """Connections that were made to it, ever."""
        self.most = 0
        """Connections to it at the same time, at most."""

    @property
    def url(self) -> str:
        """Address of the server by way of the proxy."""
        return f"redis://{HOST}:{self.port}"

    def set(self, mode: Mode, delay: float | tuple[float, float] = 0.0) -> None:
        """From now on this is what happens.

        Args:
            mode: to the bytes of all connections, in both directions.
            delay: s that "slow" takes at least in each direction; or two bounds of a random one.
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
        assert self._server is not None
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
        assert connection is not None
        self._connections.add(connection)
        self.most = max(self.most, len(self._connections))
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
            pass  # as cancelled by us alone, there is nobody to tell
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
                    await asyncio.sleep(random.uniform(*self._delay))
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
    """Starts a server that ends with the stack."""
    program = _program("redis-server")
    for _ in range(_ATTEMPTS):  # as somebody else may take the port first
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
    """Whether it answers; waits until it does or has ended."""
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
        pytest.skip(f"{name} is not installed")
    return found


def _joined(node: Process) -> bool:
    """Whether a cluster node knows that all are well."""
    return "cluster_state:ok" in node.text("CLUSTER INFO") and node.text("CLUSTER NODES").count("slave") == 3


def _knows_all(watcher: Process) -> bool:
    """Whether a Sentinel knows of the replica and of both other Sentinels."""
    return "status=ok" in (told := watcher.text("INFO")) and "slaves=1,sentinels=3" in told
