"""Messages that many watchers get: each encoding is made once."""

import asyncio
from collections.abc import Callable
from concurrent.futures import Executor

from google.protobuf.message import Message


class SharedMessage:
    """A message and its encodings. Used on one event loop; encodings are made in threads."""

    def __init__(
        self,
        message: Message | Callable[[], Message],
        threads: Executor,
        size: int | None = None,
        json: Callable[[], bytes] | None = None,
    ) -> None:
        """
        Args:
            message: the message, or what makes it, in a thread, where somebody needs it.
            threads: executor that encodes it, which may take milliseconds.
            size: bytes of the message in protobuf, about; None: as the message says.
            json: writes it as JSON faster than the message can be; None: the message is written.
        """
        self._message = message
        self._threads = threads
        self._encoded: dict[Encoder, asyncio.Future[bytes]] = {}
        self.json = json
        """Writes it as JSON; None: the message is to be written."""
        self.size = self.message.ByteSize() if size is None else size
        """Bytes of the message in protobuf, about."""

    @property
    def message(self) -> Message:
        """The message, which does not change any more."""
        if not isinstance(self._message, Message):
            self._message = self._message()
        return self._message

    async def encoded(self, encode: "Encoder") -> bytes:
        """Return an encoding, which the first caller makes and all others wait for.

        Args:
            encode: the encoder, the same function for all callers of a transport.
        """
        future = self._encoded.get(encode)
        if future is None:
            future = asyncio.get_running_loop().run_in_executor(self._threads, encode, self)
            self._encoded[encode] = future
        return await asyncio.shield(future)  # others wait for it even if this caller goes away


Encoder = Callable[[SharedMessage | Message], bytes]


def to_protobuf(event: SharedMessage | Message) -> bytes:
    """Return an event in protobuf."""
    message = event.message if isinstance(event, SharedMessage) else event
    return message.SerializeToString()
