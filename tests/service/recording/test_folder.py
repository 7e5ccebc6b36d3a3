"""Files of a recording: their contents, their number and their size."""

from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import make_reader

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.digest import raster_digest
from cab_forecast.recordings import read_recording
from service.recording.folder import CALLS, GRID, MAPS, RecordingFolder, TooLargeCallError
from tests.service.recording.calls import VERSION, answered, folder_at, raster


def files(path: Path) -> list[Path]:
    """Return the files of a recording, the oldest first."""
    return sorted(path.glob("*.mcap"))


def topics(file: Path) -> Counter[str]:
    """Return the number of messages of a file by topic."""
    with file.open("rb") as stream:
        return Counter(channel.topic for _, channel, _ in make_reader(stream).iter_messages())


def fill(folder: RecordingFolder, calls: int) -> None:
    """Write calls that cannot be compressed much, and end the file."""
    for number in range(calls):
        folder.write(answered(road=raster(number, side=100)))
    folder.finish()


def test_a_file_ends_before_it_is_too_large_and_the_oldest_is_deleted(tmp_path: Path) -> None:
    limit = 2**18
    fill(folder_at(tmp_path, file_bytes=limit, files=3), 20)
    first = files(tmp_path)
    assert len(first) == 3
    assert all(file.stat().st_size <= limit for file in first)
    calls = sum(topics(file)[CALLS] for file in first)
    assert 3 <= calls < 20
    fill(folder_at(tmp_path, file_bytes=limit, files=3), 1)  # as after a restart
    assert len(files(tmp_path)) == 3
    assert files(tmp_path)[:2] == first[1:]


def test_files_of_a_larger_limit_make_room(tmp_path: Path) -> None:
    fill(folder_at(tmp_path, files=4), 20)
    assert files(tmp_path)[0].stat().st_size > 2**18
    fill(folder_at(tmp_path, file_bytes=2**18, files=3), 1)
    assert sum(file.stat().st_size for file in files(tmp_path)) <= 3 * 2**18


def test_files_of_others_stay(tmp_path: Path) -> None:
    others = [tmp_path / "notes.txt", tmp_path / "drive.mcap"]
    for other in others:
        other.touch()
    fill(folder_at(tmp_path, file_bytes=2**18, files=2), 20)
    assert all(other.exists() for other in others)


def test_a_map_is_in_a_file_once(tmp_path: Path) -> None:
    folder = folder_at(tmp_path)
    one, other = raster(1), raster(2)
    for road in (one, one, other, one):
        folder.write(answered(road=road))
    folder.finish()
    folder.write(answered(road=one))
    folder.finish()
    first, second = files(tmp_path)
    assert topics(first)[MAPS] == 2
    assert topics(first)[GRID] == 3  # the viewer shows the newest, so a map that comes back is drawn again
    assert topics(second)[MAPS] == topics(second)[GRID] == 1
    images = [call.request.scene_raster for file in (first, second) for call in read_recording(file)]
    assert images == [answered(road=road).request.scene_raster for road in (one, one, other, one, one)]


def test_a_map_that_a_call_names_by_its_digest_is_recorded(tmp_path: Path) -> None:
    folder = folder_at(tmp_path)
    road = raster(3, side=41)
    sent = answered(road=road)
    named = answered(road=road)
    named.request.scene_raster.CopyFrom(pb.SceneRaster(digest=raster_digest(sent.request.scene_raster)))
    folder.write(named)  # its image came before the recording began
    folder.write(sent)
    folder.finish()
    [file] = files(tmp_path)
    assert topics(file)[MAPS] == 1
    for call in read_recording(file):
        assert call.request.scene_raster == sent.request.scene_raster


def test_a_call_beyond_the_size_of_a_file_is_refused_and_the_next_one_is_not(tmp_path: Path) -> None:
    folder = folder_at(tmp_path, file_bytes=2**18)
    folder.write(answered())
    with pytest.raises(TooLargeCallError):
        folder.write(answered(road=raster(side=400)))
    folder.write(answered())
    folder.finish()
    [file] = files(tmp_path)
    assert topics(file)[CALLS] == 2


def test_what_a_killed_server_wrote_can_be_read(tmp_path: Path) -> None:
    folder = folder_at(tmp_path)
    for number in range(3):
        folder.write(answered(road=raster(), time_ns=number))
    [file] = files(tmp_path)
    whole = file.read_bytes()
    calls = list(read_recording(file))
    assert len(calls) == 3
    assert calls[0].server_version == VERSION
    file.write_bytes(whole[:-100])  # killed in the middle of a call
    assert list(read_recording(file)) == calls[:2]
    folder.abandon()


def test_others_may_not_read_it(tmp_path: Path) -> None:
    fill(folder_at(tmp_path), 1)
    [file] = files(tmp_path)
    assert file.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("content", [b"", b"no recording", bytes(200)])
def test_another_file_is_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "other.mcap"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"other\.mcap"):
        list(read_recording(file))


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    folder = folder_at(tmp_path)
    folder.write(answered())
    folder.finish()
    [file] = files(tmp_path)
    content = bytearray(file.read_bytes())
    content[400] ^= 0xFF  # in the first chunk
    file.write_bytes(content)
    with pytest.raises(ValueError, match="damaged"):
        list(read_recording(file))
