"""The recorder between the event loop and the disk."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from mcap.reader import make_reader
from structlog.testing import capture_logs

from cab_forecast.recordings import read_recording
from service.recording import recorder as module
from service.recording.call import AnsweredCall
from service.recording.folder import RecordingFolder
from service.recording.recorder import Recorder
from service.telemetry.metrics import Metrics
from tests.service.recording.calls import answered, folder_at, raster
from tests.service.recording.disk import files_up_to


class Recording:
    """A recorder at work, and what it counts."""

    def __init__(self, folder: RecordingFolder, share: float = 1.0) -> None:
        self.metrics = Metrics()
        self.recorder = Recorder(folder, share, self.metrics, retry_seconds=0.05)

    def record(self, call: AnsweredCall) -> None:
        self.recorder.record(call.request, call.response, call.raster, call.histories)

    def count(self, result: str) -> int:
        value = self.metrics.registry.get_sample_value("forecast_recorded_calls_total", {"result": result})
        assert value is not None
        return int(value)

    @property
    def active(self) -> bool:
        return self.metrics.registry.get_sample_value("forecast_recording") == 1


@contextmanager
def recording(folder: RecordingFolder, share: float = 1.0) -> Iterator[Recording]:
    """Run a recorder."""
    running = Recording(folder, share)
    running.recorder.start()
    try:
        yield running
    finally:
        running.recorder.close(10)


def wait(condition: Callable[[], object]) -> None:
    """Wait until the condition holds."""
    end = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def written(path: Path) -> int:
    """Return the number of calls in all files of a folder."""
    return sum(len(list(read_recording(file))) for file in path.glob("*.mcap"))


def test_calls_are_written_and_counted(tmp_path: Path) -> None:
    with recording(folder_at(tmp_path)) as running:
        assert running.active
        for _ in range(5):
            running.record(answered())
    assert not running.active
    assert running.count("written") == written(tmp_path) == 5


def test_a_share_of_the_calls_is_recorded(tmp_path: Path) -> None:
    with recording(folder_at(tmp_path), share=0.25) as running:
        call = answered(agents=1)
        for _ in range(400):
            running.record(call)
            wait(lambda: running.recorder._queue.qsize() < 100)
    assert 50 < running.count("written") < 150


@pytest.mark.parametrize("bound", ["MAX_WAITING_CALLS", "MAX_WAITING_BYTES"])
def test_calls_beyond_the_queue_are_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bound: str
) -> None:
    call = answered()
    monkeypatch.setattr(module, bound, 3 if bound == "MAX_WAITING_CALLS" else 3 * call.size)
    folder = folder_at(tmp_path)
    free, entered = threading.Event(), threading.Event()
    write = folder.write

    def slow_write(call: AnsweredCall) -> None:
        entered.set()
        assert free.wait(10)
        write(call)

    monkeypatch.setattr(folder, "write", slow_write)
    with recording(folder) as running:
        running.record(call)
        assert entered.wait(10)
        for _ in range(10):
            running.record(call)
        free.set()
    # The call that is being written counts among the bytes, not among the calls
    accepted = 4 if bound == "MAX_WAITING_CALLS" else 3
    assert (running.count("written"), running.count("queue_full")) == (accepted, 11 - accepted)
    assert written(tmp_path) == accepted


def test_a_full_disk_is_logged_once_and_recording_goes_on_when_there_is_room(tmp_path: Path) -> None:
    with capture_logs() as logs, recording(folder_at(tmp_path, files=100)) as running:
        with files_up_to(100_000):
            for number in range(40):
                running.record(answered(road=raster(number, side=300)))
            wait(lambda: running.count("written") + running.count("disk_full") == 40)
            assert not running.active
            time.sleep(0.2)
            running.record(answered(road=raster(side=300)))  # still no room
            wait(lambda: running.count("written") + running.count("disk_full") == 41)
        kept = running.count("written")
        assert running.count("disk_full") == 41 - kept > 0

        def lasts() -> bool:
            running.record(answered(road=raster(side=300)))
            return running.active

        wait(lasts)
    events = [entry["event"] for entry in logs if entry["log_level"] == "warning"]
    assert events == ["recording paused until there is room", "recording goes on"]
    assert written(tmp_path) == running.count("written") > kept


def test_some_of_the_disk_is_left_free(tmp_path: Path) -> None:
    with capture_logs() as logs, recording(folder_at(tmp_path, reserve_bytes=2**62)) as running:
        running.record(answered())
        wait(lambda: running.count("disk_full") == 1)
        running.record(answered())
    assert running.count("disk_full") == 2
    assert not list(tmp_path.iterdir())
    [entry] = [entry for entry in logs if entry["log_level"] == "warning"]
    assert entry["error"] == "No space left on device"


def test_a_file_is_ended_while_there_is_room_for_its_index(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = folder_at(tmp_path)
    with recording(folder) as running:
        running.record(answered())
        wait(lambda: running.count("written") == 1)
        monkeypatch.setattr(folder, "_reserve_bytes", 2**62)
        running.record(answered())
        wait(lambda: running.count("disk_full") == 1)
        [file] = tmp_path.iterdir()
        with file.open("rb") as stream:
            assert make_reader(stream).get_summary() is not None


def test_a_fault_of_the_recorder_costs_its_call_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = folder_at(tmp_path)
    write = folder.write

    def faulty(call: AnsweredCall) -> None:
        if not call.histories:
            raise RuntimeError("a bug")
        write(call)

    monkeypatch.setattr(folder, "write", faulty)
    with capture_logs() as logs, recording(folder) as running:
        for histories in ({}, {}, {"a0": b""}):
            running.record(answered(histories=histories))
    assert (running.count("failed"), running.count("written")) == (2, 1)
    assert [entry["log_level"] for entry in logs] == ["error"]
