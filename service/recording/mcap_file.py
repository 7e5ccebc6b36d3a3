"""One MCAP file of a recording."""

import os
from collections.abc import Sequence
from contextlib import suppress
from io import BytesIO, FileIO
from pathlib import Path
from typing import TypeAlias

from google.protobuf.message import Message
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

TopicMessage: TypeAlias = tuple[str, Message]

_NEVER = 2**62
"""Chunk size that is not reached: a chunk ends with its call."""
_FRAME_BYTES = 2**17
"""Bytes of a file besides its calls, at most: schemas and channels at the beginning and at the end."""
_INDEX_BYTES = 512
"""Bytes of a chunk's entries in the indexes, at most."""
_RECORD_BYTES = 64
"""Bytes of a message's record besides its data, at most."""


class McapFile:
    """A file that is being written. Each call to ``write`` is a chunk of its own, and complete on disk.

    Without the ``finish`` it has no index, but all its chunks can be read.
    """

    def __init__(self, path: Path, library: str) -> None:
        """
        Args:
            path: the file, which must not exist.
            library: name and version of the program that writes.

        Raises:
            OSError: the file cannot be written.
        """
        self.path = path
        self.digests: set[str] = set()
        """Digests of the maps in this file."""
        self._broken = False
        """Flag for a write that failed: the index would list what is not there."""
        self._chunks = 0
        self._channels: dict[str, int] = {}
        self._pending = _Pending()
        self._writer = Writer(self._pending, chunk_size=_NEVER, compression=CompressionType.ZSTD)
        self._writer.start(library=library)
        self._file = FileIO(path, "xb", opener=_open_privately)
        try:
            self._commit()
        except OSError:
            self.close()
            raise

    @staticmethod
    def bytes_with(messages: Sequence[TopicMessage]) -> int:
        """Return the max size of a finished file that holds these messages alone."""
        return _FRAME_BYTES + _chunk_bytes(messages)

    def has_room(self, messages: Sequence[TopicMessage], max_bytes: int) -> bool:
        """Return whether the finished file is no larger than ``max_bytes`` with these messages, too."""
        index = self._chunks * _INDEX_BYTES
        return self._pending.start + index + self.bytes_with(messages) <= max_bytes

    def write(self, messages: Sequence[TopicMessage], time_ns: int, sequence: int) -> None:
        """Write messages at once: either all or none of them are in the file.

        Args:
            messages: topics and messages.
            time_ns: their time, ns since the epoch.
            sequence: number of the call.

        Raises:
            OSError: they cannot be written; the file can only be closed then.
        """
        for topic, message in messages:
            self._writer.add_message(
                self._channel(topic, message), time_ns, message.SerializeToString(), time_ns, sequence
            )
        self._writer.flush()
        self._chunks += 1
        self._commit()

    def finish(self) -> None:
        """Write the index and close the file; after an error of ``write`` close it as it is.

        Raises:
            OSError: the index cannot be written; the file is closed without it.
        """
        try:
            if not self._broken:
                self._writer.finish()
                self._commit()
        finally:
            self.close()

    def close(self) -> None:
        """Close the file as it is."""
        with suppress(OSError):
            self._file.close()

    def _channel(self, topic: str, message: Message) -> int:
        """Return the channel of a topic, with the schema of its messages."""
        if topic not in self._channels:
            schema = register_schema(self._writer, type(message))
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.Protobuf, schema)
        return self._channels[topic]

    def _commit(self) -> None:
        """Write what is pending to the disk; after an error the file ends where it ended before."""
        end = self._pending.start
        data = memoryview(self._pending.take())
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError:
            self._broken = True
            with suppress(OSError):
                os.ftruncate(self._file.fileno(), end)
            raise


def _open_privately(path: str, flags: int) -> int:
    """Open a file that its owner alone may read: it tells where people were."""
    return os.open(path, flags, 0o600)


def _chunk_bytes(messages: Sequence[TopicMessage]) -> int:
    """Return the max size by which messages, written at once, make a file grow."""
    return _INDEX_BYTES + sum(message.ByteSize() + _RECORD_BYTES for _, message in messages)


class _Pending(BytesIO):
    """Bytes of a file that are not yet written."""

    def __init__(self) -> None:
        super().__init__()
        self.start = 0
        """Position of the first of them in the file."""

    def tell(self) -> int:
        """Return the position in the file."""
        return self.start + super().tell()

    def take(self) -> bytes:
        """Return the pending bytes, and hold none any more."""
        data = self.getvalue()
        self.start += len(data)
        self.seek(0)
        self.truncate()
        return data
