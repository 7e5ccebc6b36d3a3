"""Messages that many watchers get: each encoding is made once."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor

from google.protobuf.message import Message

Encoder = Callable[[Message], bytes]


class SharedMessage:
    """A message and its encodings. Used on one event loop."""

    def __init__(self, message: Message, threads: Executor) -> None:
        """
        Args:
            message: the message, which does not change any more.
            threads: executor that encodes it, which may take milliseconds.
        """
        self.message = message
        self.size = message.ByteSize()
        """Bytes of the message in protobuf."""
        self._threads = threads
        self._encoded: dict[Encoder, asyncio.Future[bytes]] = {}

    async def encoded(self, encode: Encoder) -> bytes:
        """Return an encoding, which the first caller makes and all others wait for.

        Args:
            encode: the encoder, the same function for all callers of a transport.
        """
        future = self._encoded.get(encode)
        if future is None:
            future = asyncio.get_running_loop().run_in_executor(self._threads, encode, self.message)
            self._encoded[encode] = future
        return await asyncio.shield(future)  # others wait for it even if this caller goes away
