"""Requests on their way in: read off the event loop, and large ones one at a time."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass

from cab.forecast.v1 import prediction_service_pb2 as pb
from service.errors import Overloaded

LARGE_BYTES = 256 * 2**10
"""A body of more is read when no other such one is: some take a second, in which they hold the interpreter
and many times their size in memory."""
MAX_WAITING = 8
"""Large bodies that wait for their turn; each is kept in memory meanwhile."""
_RETRY_AFTER = 1.0
"""s, about what the largest body takes."""


@dataclass(frozen=True)
class Encoded:
    """A request that was not read yet."""

    body: bytes
    read: Callable[[bytes], pb.PredictRequest]
    """Raises a ServiceError where the body is no request."""
    quick_bytes: int = 0
    """Bytes up to which reading takes less time than handing it to a thread does."""


class Reader:
    """Reads requests; lives on one event loop."""

    def __init__(self, threads: Executor) -> None:
        self._threads = threads
        self._turn = asyncio.Lock()
        self._waiting = 0

    async def read(self, encoded: Encoded) -> pb.PredictRequest:
        """The request.

        Raises:
            Overloaded: it is large, and so are too many that came before it.
            ServiceError: whatever its ``read`` raises.
        """
        size = len(encoded.body)
        if size <= encoded.quick_bytes:
            return encoded.read(encoded.body)
        if size <= LARGE_BYTES:
            return await self._in_thread(encoded)
        if self._waiting >= MAX_WAITING:
            raise Overloaded(f"{self._waiting} large requests are waiting to be read", _RETRY_AFTER)
        self._waiting += 1
        try:
            await self._turn.acquire()
        finally:
            self._waiting -= 1
        reading = self._in_thread(encoded)
        reading.add_done_callback(self._pass_turn)
        # A thread cannot be stopped: the turn lasts until it is through, whoever still waits for it
        return await asyncio.shield(reading)

    def _in_thread(self, encoded: Encoded) -> "asyncio.Future[pb.PredictRequest]":
        return asyncio.get_running_loop().run_in_executor(self._threads, encoded.read, encoded.body)

    def _pass_turn(self, reading: "asyncio.Future[pb.PredictRequest]") -> None:
        self._turn.release()
        if not reading.cancelled():
            reading.exception()  # looked at, or asyncio would complain if the call has gone
