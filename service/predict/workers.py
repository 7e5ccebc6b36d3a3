"""Processes that run forwards (``FORECAST_WORKERS``).

A forward needs the interpreter while it joins features and cuts map patches, and so does the event loop,
which decodes, plans and encodes the calls: in one process each waits for the other. A worker is a process
with an interpreter of its own that does nothing but forwards. The queue, the track memory, metrics and
transports stay in the server's process, so limits, sums and digests are those of one server.

Arrays lie in memory that both processes share; a socket carries the rest. What crosses it are pickles of the
server's own objects, between two processes that nobody else can write to: parameters of models have been
read from safetensors before.
"""

import io
import mmap
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import structlog
import torch

from model.checkpoint import Checkpoint
from model.forecaster import Forecaster, ModelInfo
from model.mixture import TrajectoryMixture
from model.networks.config import AnyNetworkConfig
from model.networks.forecaster import NetworkForecaster
from service.predict.canary import straight_scene
from service.predict.forward import Batch, Forwarded, forward
from service.predict.torch_threads import make_cutters

_log = structlog.get_logger(__name__)

ARENA_BYTES = 32 * 2**20
"""Size of the shared memory of each direction: 128 agents with a raster of their own each fit. It takes real
memory only where it has been written."""
_COMMAND = f"from {__name__} import main; main()"
"""Python code of a worker. With ``-m`` the classes of messages would be defined twice in it."""
_ALLOCATION = {"MALLOC_MMAP_THRESHOLD_": str(2**25), "MALLOC_TRIM_THRESHOLD_": str(2**30)}
"""Environment in which glibc keeps freed memory. It would give that of each forward back to the system, and
the next forward would find a thousand pages missing: 3 of 25 ms with 32 agents. glibc before 2.35 takes no
higher threshold for single pieces than 32 MiB."""
_END_SECONDS = 2.0
"""Seconds that a worker gets to end by itself."""
_FIRST_PAUSE, _MAX_PAUSE = 0.5, 60.0
"""s before a worker that died is replaced: the first time, and at most after deaths soon after each other."""
_HEALTHY_SECONDS = 60.0
"""A worker that lived longer is replaced as the first one."""


_SCENE_AGENTS = 8
_SPEED = 5.0
"""m/s; agents of the scene of the first forwards, and their speed."""


class WorkerDiedError(RuntimeError):
    """The worker died during a forward; another may run the next one."""


@dataclass(frozen=True)
class _Load:
    """Message to a worker: a model to load."""

    key: int
    info: ModelInfo
    network: AnyNetworkConfig
    tensors: dict[str, torch.Tensor]
    is_compiled: bool
    """True if its forward is a native call; else it runs in PyTorch."""
    max_batch: int
    """Number of agents of the largest first forward."""


@dataclass(frozen=True)
class _Forget:
    """Message to a worker: models that are gone."""

    keys: frozenset[int]


@dataclass(frozen=True)
class _Forward:
    """Message to a worker: a batch."""

    key: int
    batch: Batch


_Message: TypeAlias = _Load | _Forget | _Forward


class SharedChannel:
    """One end of a socket with shared memory for arrays, for messages that take turns.

    The arrays of a received message lie in the memory until the other end sends the next one.

    Args:
        connection: the socket.
        outgoing: memory for the arrays of sent messages.
        incoming: memory of those of received ones.
    """

    def __init__(self, connection: Connection, outgoing: int, incoming: int) -> None:
        self._connection = connection
        self._outgoing = mmap.mmap(outgoing, ARENA_BYTES)
        self._incoming = mmap.mmap(incoming, ARENA_BYTES)

    def send(self, message: object) -> None:
        """Send a message.

        Raises:
            OSError: the other end is gone.
        """
        buffers: list[pickle.PickleBuffer] = []
        stream = io.BytesIO()
        _Pickler(stream, protocol=5, buffer_callback=buffers.append).dump(message)
        raws = [buffer.raw() for buffer in buffers]
        sizes = [raw.nbytes for raw in raws]
        if sum(sizes) > ARENA_BYTES:  # the arrays travel in the message
            stream, sizes = io.BytesIO(), []
            _Pickler(stream, protocol=5).dump(message)
        else:
            position = 0
            for raw in raws:
                self._outgoing[position : position + raw.nbytes] = raw
                position += raw.nbytes
        self._connection.send_bytes(pickle.dumps((sizes, stream.getvalue())))

    def receive(self) -> Any:
        """Return the next message.

        Raises:
            EOFError: the other end is gone.
            OSError: likewise.
        """
        sizes, content = pickle.loads(self._connection.recv_bytes())  # noqa: S301 (our own, see above)
        ends = np.cumsum(sizes, dtype=np.int64).tolist()
        memory = memoryview(self._incoming)
        buffers = [memory[end - size : end] for size, end in zip(sizes, ends, strict=True)]
        return pickle.loads(content, buffers=buffers)  # noqa: S301 (likewise)

    def close(self) -> None:
        """Close the socket; the memory goes with the last array in it."""
        self._connection.close()


class _Pickler(pickle.Pickler):
    """Pickler that passes tensors as arrays, and arrays whole."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, torch.Tensor):
            return torch.from_numpy, (value.numpy(),)
        if isinstance(value, np.ndarray) and not value.flags.c_contiguous:
            return np.ascontiguousarray(value).__reduce_ex__(5)
        return NotImplemented


class Worker:
    """A process for forwards as one thread of the server uses it, and its replacement after a death.

    Until the process has loaded the models, and while it is replaced, forwards run in the calling thread.

    Args:
        number: number of the worker, for the log.
        width: number of threads of its forwards.
        on_death: called in some thread when a process has died.
    """

    def __init__(self, number: int, width: int, on_death: Callable[[], None]) -> None:
        self._number = number
        self._width = width
        self._on_death = on_death
        self._lock = threading.Lock()
        self._models: dict[int, _Load] = {}
        self._process: _Process | None = None
        self._pause = _FIRST_PAUSE
        self._closed = threading.Event()
        self._starting: threading.Thread | None = None

    @property
    def is_ready(self) -> bool:
        """True if the process runs forwards."""
        process = self._process
        return process is not None and process.is_alive

    @property
    def pid(self) -> int | None:
        """Id of the process; None: there is none at the moment."""
        process = self._process
        return None if process is None else process.pid

    def start(self, forecasters: Iterable[Forecaster], default: Forecaster, max_batch: int) -> None:
        """Begin to start the process, with models that it loads before its first forward.

        Args:
            forecasters: the models.
            default: the one that most calls use: its first forwards are of all sizes.
            max_batch: max number of agents in one forward.
        """
        for forecaster in forecasters:
            if isinstance(forecaster, NetworkForecaster):
                self._loading(forecaster, max_batch if forecaster is default else _SCENE_AGENTS)
        self._start_in_thread(0.0)

    def forward(self, forecaster: Forecaster, batch: Batch, cutters: Executor | None = None) -> Forwarded:
        """Run a forward in the process if there is one and the forecaster is a network, else here.

        Args and result are those of ``forward.forward``.

        Raises:
            WorkerDiedError: the process died during the forward.
            RuntimeError: the forward failed.
        """
        process = self._live_process()
        if process is None or not isinstance(forecaster, NetworkForecaster):
            return forward(forecaster, batch, cutters)
        load = self._loading(forecaster)
        try:
            process.load(load)
            return process.forward(_Forward(load.key, batch))
        except (EOFError, OSError) as error:
            self._replace(process)
            raise WorkerDiedError(f"worker {self._number} died during a forward") from error

    def forget(self, keys: Iterable[int]) -> None:
        """Forget models that are gone. Called in the thread of the forwards."""
        gone = frozenset(keys)
        with self._lock:
            for key in gone:
                self._models.pop(key, None)
        process = self._live_process()
        if process is not None:
            try:
                process.forget(gone)
            except (EOFError, OSError):
                self._replace(process)

    def close(self) -> None:
        """End the process."""
        self._closed.set()
        if self._starting is not None:
            self._starting.join()
        if self._process is not None:
            self._process.end()

    def _loading(self, forecaster: NetworkForecaster[Any], max_batch: int = _SCENE_AGENTS) -> _Load:
        """Return the message that loads a model, which a replacement gets, too."""
        key = id(forecaster)
        with self._lock:
            if key not in self._models:
                tensors = dict(forecaster.networks.state_dict())
                compiled = forecaster.is_compiled
                self._models[key] = _Load(
                    key, forecaster.info, forecaster.config, tensors, compiled, max_batch
                )
            return self._models[key]

    def _live_process(self) -> "_Process | None":
        """Return the process if it is alive; if it has died meanwhile, begin to replace it."""
        process = self._process
        if process is not None and not process.is_alive:
            self._replace(process)
            return None
        return process

    def _replace(self, dead: "_Process") -> None:
        """Begin to replace a process that has died."""
        self._process = None
        lived = time.monotonic() - dead.since
        self._pause = _FIRST_PAUSE if lived > _HEALTHY_SECONDS else min(2 * self._pause, _MAX_PAUSE)
        status = dead.end()
        _log.error("worker died", worker=self._number, pid=dead.pid, status=status, lived_s=round(lived, 1))
        self._on_death()
        self._start_in_thread(self._pause)

    def _start_in_thread(self, pause: float) -> None:
        name = f"worker-{self._number}"
        self._starting = threading.Thread(target=self._start, args=(pause,), name=name, daemon=True)
        self._starting.start()

    def _start(self, pause: float) -> None:
        """Start a process after a pause, and use it once it has loaded the models."""
        if self._closed.wait(pause):
            return
        process = _Process(self._width)
        try:
            while not self._closed.is_set():
                with self._lock:  # models may come and go while others are loaded
                    missing = [load for key, load in self._models.items() if key not in process.keys]
                    if not missing:
                        self._process = process
                        break
                process.load(missing[0])
            else:
                process.end()
                return
        except (EOFError, OSError):
            self._replace(process)
            return
        except RuntimeError:
            _log.exception("worker cannot load a model", worker=self._number)
            process.end()
            return
        _log.info("worker started", worker=self._number, pid=process.pid)


class _Process:
    """A running worker process, and the models that it has loaded."""

    def __init__(self, width: int) -> None:
        """
        Args:
            width: number of threads of a forward.
        """
        ours, theirs = socket.socketpair()
        memory = [os.memfd_create(f"forecast-{name}", os.MFD_CLOEXEC) for name in ("parts", "mixtures")]
        try:
            for one in memory:
                os.ftruncate(one, ARENA_BYTES)
            numbers = [theirs.fileno(), *memory]
            self._process = subprocess.Popen(  # noqa: S603 (our own module)
                [sys.executable, "-c", _COMMAND, *map(str, numbers), str(width)],
                pass_fds=numbers,
                env=_ALLOCATION | os.environ,
                stdin=subprocess.DEVNULL,
            )
            self._channel = SharedChannel(Connection(ours.detach()), *memory)
        finally:
            theirs.close()
            for one in memory:
                os.close(one)
        self.since = time.monotonic()
        """Time of its start, by ``time.monotonic``."""
        self.keys: set[int] = set()
        """Keys of the models that it has loaded."""

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        """True if the process runs."""
        return self._process.poll() is None

    def load(self, load: _Load) -> None:
        """Load a model, unless it is loaded.

        Raises:
            EOFError: the process died.
            OSError: likewise.
        """
        if load.key not in self.keys:
            self._ask(load)
            self.keys.add(load.key)

    def forget(self, keys: frozenset[int]) -> None:
        """Forget models.

        Raises:
            EOFError: the process died.
            OSError: likewise.
        """
        self._ask(_Forget(keys))
        self.keys -= keys

    def forward(self, message: _Forward) -> Forwarded:
        """Run a forward.

        Raises:
            RuntimeError: it failed.
            EOFError: the process died.
            OSError: likewise.
        """
        done: Forwarded = self._ask(message)
        mixture = done.mixture
        # The memory is written anew by the next forward
        owned = (mixture.log_weights, mixture.means, mixture.covariances, mixture.origin)
        return done._replace(mixture=TrajectoryMixture(*(tensor.clone() for tensor in owned)))

    def end(self) -> int:
        """End the process, and return its exit status."""
        self._channel.close()
        try:
            return self._process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return self._process.wait()

    def _ask(self, message: _Message) -> Any:
        self._channel.send(message)
        answer = self._channel.receive()
        if isinstance(answer, Exception):
            raise answer
        return answer


class _Models:
    """The models of a worker process, and what it does with them."""

    def __init__(self, width: int) -> None:
        torch.set_num_threads(width)
        self._width = width
        self._cutters = make_cutters(width)
        self._forecasters: dict[int, Forecaster] = {}

    def answer(self, message: _Message) -> object:
        """Return the answer to a message."""
        if isinstance(message, _Forward):
            return forward(self._forecasters[message.key], message.batch, self._cutters)
        if isinstance(message, _Load):
            # Parameters outlive the message, whose memory is written anew
            tensors = {name: tensor.clone() for name, tensor in message.tensors.items()}
            forecaster = Checkpoint(Path(), message.info, message.network, tensors).forecaster()
            if message.is_compiled:
                forecaster.compile(self._width)
            self._warm_up(forecaster, message.max_batch)
            self._forecasters[message.key] = forecaster
        else:
            for key in message.keys:
                self._forecasters.pop(key, None)
        return None

    def _warm_up(self, forecaster: Forecaster, max_batch: int) -> None:
        """Run the first forwards, which allocate and cache, before a call waits for one."""
        info = forecaster.info
        for agent_type in info.agent_types:
            scene = straight_scene(agent_type, info.history_frames, [_SPEED] * max_batch)
            for context in info.contexts:
                whole = forecaster.view(scene, np.arange(max_batch), context)
                for agents in {min(_SCENE_AGENTS, max_batch), max_batch}:
                    batch = Batch(agent_type, context, [whole[:agents]], info.steps)
                    forward(forecaster, batch, self._cutters)


def main() -> None:
    """Run a worker: answer messages until the server closes the socket."""
    connection, incoming, outgoing, width = map(int, sys.argv[1:5])
    # Signals to the whole group are for the server, which still needs its workers while it drains
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    channel = SharedChannel(Connection(connection), outgoing, incoming)
    models = _Models(width)
    while True:
        try:
            message: _Message = channel.receive()
        except (EOFError, OSError):
            os._exit(0)  # at once: there is nothing to save, and libraries take a second to end
        answer: object
        try:
            answer = models.answer(message)
        except Exception as error:  # the server reports it for the calls of the batch
            answer = RuntimeError(f"{type(error).__name__}: {error}")
        channel.send(answer)
