"""The recorder: takes answered calls from the event loop and writes them in a thread of its own."""

import random
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from queue import Empty, SimpleQueue

import structlog

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.scenes.scene import Raster
from service.recording.call import AnsweredCall
from service.recording.folder import RecordingFolder, TooLargeCallError
from service.telemetry.metrics import Metrics

_log = structlog.get_logger(__name__)

MAX_WAITING_CALLS = 256
"""Max number of calls that wait to be written."""
MAX_WAITING_BYTES = 64 * 2**20
"""Max size of the calls that wait to be written."""
RETRY_SECONDS = 10.0
"""Seconds until a recorder that has paused looks for room on the disk again."""


class Recorder:
    """Recorder of answered calls. It delays no call and raises nothing: what it cannot write, it counts."""

    def __init__(
        self,
        folder: RecordingFolder,
        share: float,
        metrics: Metrics,
        retry_seconds: float = RETRY_SECONDS,
    ) -> None:
        """
        Args:
            folder: the folder of the recording.
            share: share of the calls to record, each drawn on its own.
            metrics: the metrics of the server.
            retry_seconds: seconds until a recorder that has paused looks for room again.
        """
        self._folder = folder
        self._share = share
        self._metrics = metrics
        self._retry_seconds = retry_seconds
        self._queue: SimpleQueue[AnsweredCall | None] = SimpleQueue()
        self._random = random.Random()  # noqa: S311 - it draws samples, not secrets
        # The event loop alone changes the first, the writer's thread alone the second, so no lock is needed
        self._accepted_bytes = 0
        self._done_bytes = 0
        self._paused = False
        self._warned = False
        """Flag for a pause that has been logged, and whose end has not."""
        self._resumed: float | None = None
        """Monotonic time of the first call written after a pause, s."""
        self._failed = False
        """Flag for a failure that has been logged."""
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._metrics.recording.set(1)
        self._thread.start()

    def record(
        self,
        request: pb.PredictRequest,
        response: pb.PredictResponse,
        raster: Raster | None,
        histories: Mapping[str, bytes],
    ) -> None:
        """Record an answered call, if it is drawn, later. Called on the event loop; takes microseconds.

        Args:
            request: the request, which does not change any more.
            response: its response, likewise.
            raster: the decoded map of the request, likewise.
            histories: the histories that came from the track memory, by agent id.
        """
        if self._random.random() >= self._share:
            return
        if self._paused:
            self._count("disk_full")
            return
        call = AnsweredCall(request, response, raster, histories, time.time_ns())
        size = call.size
        waiting = self._accepted_bytes - self._done_bytes
        if self._queue.qsize() >= MAX_WAITING_CALLS or waiting + size > MAX_WAITING_BYTES:
            self._count("queue_full")
            return
        self._accepted_bytes += size
        self._queue.put(call)

    def close(self, seconds: float) -> None:
        """Write what waits, and end the file.

        Args:
            seconds: time for it; what is not written then is lost.
        """
        self._queue.put(None)
        self._thread.join(seconds)
        if self._thread.is_alive():
            _log.warning("recording cut off", calls=self._queue.qsize())
        self._metrics.recording.set(0)

    def _run(self) -> None:
        while True:
            try:
                call = self._queue.get(timeout=self._retry_seconds if self._paused else None)
            except Empty:
                self._look_for_room()
                continue
            if call is None:
                break
            if self._paused:
                self._count("disk_full")
            else:
                self._write(call)
            self._done_bytes += call.size
        self._finish()

    def _write(self, call: AnsweredCall) -> None:
        try:
            self._folder.write(call)
        except TooLargeCallError:
            self._count("too_large")
        except OSError as error:
            self._count("disk_full")
            self._pause(error)
        except Exception:
            self._count("failed")
            self._folder.abandon()
            if not self._failed:
                self._failed = True
                _log.exception("call not recorded; further ones are counted only")
        else:
            self._count("written")
            self._check_lasting()

    def _pause(self, error: OSError) -> None:
        with suppress(OSError):
            self._folder.finish()
        self._paused = True
        self._resumed = None
        self._metrics.recording.set(0)
        if not self._warned:
            self._warned = True
            _log.warning("recording paused until there is room", error=error.strerror or str(error))

    def _check_lasting(self) -> None:
        """Log the end of a pause once it lasts; a disk at its limit takes a few calls after every pause."""
        if not self._warned:
            return
        now = time.monotonic()
        if self._resumed is None:
            self._resumed = now
        elif now >= self._resumed + self._retry_seconds:
            self._warned = False
            self._metrics.recording.set(1)
            _log.warning("recording goes on")

    def _look_for_room(self) -> None:
        try:
            self._folder.check_room()
        except OSError:
            return
        self._paused = False  # the next call tells whether it can be written

    def _finish(self) -> None:
        try:
            self._folder.finish()
        except OSError as error:
            _log.warning("recording without an index", error=error.strerror)

    def _count(self, result: str) -> None:
        self._metrics.recorded_calls.labels(result).inc()
