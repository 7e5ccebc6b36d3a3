"""The folder of a recording: which files it holds, and what is written of a call."""

import errno
import os
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from service.recording.call import AnsweredCall, map_digest, recorded_call, recorded_map
from service.recording.frames import agents_frame, timestamp
from service.recording.map_grid import map_grid
from service.recording.mcap_file import McapFile, TopicMessage
from service.recording.scene_update import scene_update

CALLS, MAPS = "/forecast/call", "/forecast/map"
"""Topics of the contract's messages, from which calls are replayed."""
SCENE, GRID, FRAMES = "/forecast/scene", "/forecast/grid", "/tf"
"""Topics of Foxglove's messages."""
_PREFIX, _SUFFIX = "forecast-", ".mcap"


class TooLargeCallError(Exception):
    """Error of a call that is larger than a file may be."""


class RecordingFolder:
    """Folder to which calls are written. Used by one thread."""

    def __init__(self, path: Path, file_bytes: int, files: int, reserve_bytes: int, version: str) -> None:
        """
        Args:
            path: the folder, which must exist.
            file_bytes: max size of a file.
            files: max number of files; the oldest ones are deleted.
            reserve_bytes: bytes that must remain free on the disk.
            version: version of the server.
        """
        self._path = path
        self._file_bytes = file_bytes
        self._files = files
        self._reserve_bytes = reserve_bytes
        self._version = version
        self._file: McapFile | None = None
        self._grid = ""
        """Digest of the map that was drawn last."""
        self._calls = 0

    def write(self, call: AnsweredCall) -> None:
        """Write a call; afterwards it is complete on disk.

        Raises:
            OSError: it cannot be written, for example because the disk is full.
            TooLargeCallError: it is larger than a file may be.
        """
        self.check_room()
        digest = map_digest(call.request)
        file = self._file
        messages = list(self._messages(call, digest, file))
        if file is None or not file.has_room(messages, self._file_bytes):
            if file is not None:
                messages = list(self._messages(call, digest, None))
            if McapFile.bytes_with(messages) > self._file_bytes:
                raise TooLargeCallError
            self.finish()
            file = self._file = self._next_file()
        self._calls += 1
        file.write(messages, call.time_ns, self._calls)
        if digest:
            file.digests.add(digest)
            self._grid = digest

    def check_room(self) -> None:
        """Refuse to write to a full disk.

        Raises:
            OSError: there is less free space than is to remain.
        """
        if shutil.disk_usage(self._path).free < self._reserve_bytes:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self._path))

    def finish(self) -> None:
        """End the current file, if any.

        Raises:
            OSError: its index cannot be written; the calls in it can be read nevertheless.
        """
        file, self._file = self._file, None
        if file is not None:
            file.finish()

    def abandon(self) -> None:
        """Close the current file without its index."""
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def _messages(self, call: AnsweredCall, digest: str, file: McapFile | None) -> Iterator[TopicMessage]:
        """Yield topics and messages of a call.

        Args:
            call: the call.
            digest: the digest of its scene raster; empty if there is none.
            file: the file that will hold them; None: a new one.
        """
        if digest and (file is None or digest not in file.digests):
            yield MAPS, recorded_map(call, digest)
        if call.raster is not None and (file is None or digest != self._grid):
            yield GRID, map_grid(call.raster, timestamp(call))
        yield CALLS, recorded_call(call, digest, self._version)
        yield SCENE, scene_update(call)
        frame = agents_frame(call)
        if frame is not None:
            yield FRAMES, frame

    def _next_file(self) -> McapFile:
        """Return a new file, after deleting old ones that exceed the limits with it."""
        old = [(path, path.stat().st_size) for path in sorted(self._path.glob(f"{_PREFIX}*{_SUFFIX}"))]
        while old and (
            len(old) >= self._files or sum(size for _, size in old) > self._file_bytes * (self._files - 1)
        ):
            path, _ = old.pop(0)
            path.unlink(missing_ok=True)
        name = f"{_PREFIX}{datetime.now(UTC):%Y%m%dT%H%M%S.%f}Z-{os.getpid()}{_SUFFIX}"
        return McapFile(self._path / name, f"cab-forecast {self._version}")
