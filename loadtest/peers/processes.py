"""Processes of peers: started, waited for until they answer, and ended with their children."""

import asyncio
import os
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import psutil

from loadtest.peers.catalog import PEERS, ROOT, interpreter
from loadtest.peers.network import HOST, ServedModel
from loadtest.wire import Wire

_START_SECONDS = 120.0
_STOP_SECONDS = 15.0
_PROBE_SECONDS = 0.1
_LOG_BYTES = 2000


@asynccontextmanager
async def running(name: str, served: ServedModel, body: bytes) -> AsyncIterator[Wire]:
    """Run a peer for the time of a block, from its first answer on.

    Args:
        name: name of the peer.
        served: the model, and the port.
        body: a request that it must answer.

    Raises:
        LookupError: the peer's package is not installed.
        RuntimeError: the peer did not start.
    """
    python, peer = interpreter(name), PEERS[name]
    if python is None:
        raise LookupError(f"{peer.package} is not installed: make peers-install")
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "proto")))}
    command = [python, "-m", f"loadtest.peers.servers.{peer.module}", *served.flags]
    with tempfile.TemporaryDirectory(prefix="peer-") as folder:
        log = Path(folder) / "log"
        with log.open("wb") as output:
            process = subprocess.Popen(  # noqa: ASYNC220, S603 - it only starts the process
                command, cwd=folder, env=environment, stderr=subprocess.STDOUT, stdout=output
            )
        address = f"{HOST}:{served.port}"
        try:
            await _until_answered(process, lambda: peer.connect(address), body, log)
            # Channels that were refused while the peer started would wait before they connect again
            wire = peer.connect(address)
            try:
                yield wire
            finally:
                await wire.close()
        finally:
            await asyncio.to_thread(_end, process)


async def _until_answered(
    process: "subprocess.Popen[bytes]", connect: Callable[[], Wire], body: bytes, log: Path
) -> None:
    give_up = time.perf_counter() + _START_SECONDS
    code = ""
    while process.poll() is None and time.perf_counter() < give_up:
        wire = connect()
        try:
            code = (await wire.call(body, None)).code
        finally:
            await wire.close()
        if code == "OK":
            return
        await asyncio.sleep(_PROBE_SECONDS)
    end = (await asyncio.to_thread(log.read_bytes))[-_LOG_BYTES:].decode(errors="replace")
    raise RuntimeError(f"the peer did not start (last answer: {code or 'none'}): {end}")


def _end(process: "subprocess.Popen[bytes]") -> None:
    """Terminate a process, and kill what is left of it and its children."""
    if process.poll() is not None:
        return
    family = [psutil.Process(process.pid), *psutil.Process(process.pid).children(recursive=True)]
    process.terminate()
    _, alive = psutil.wait_procs(family, timeout=_STOP_SECONDS)
    for one in alive:
        one.kill()
    process.wait()
