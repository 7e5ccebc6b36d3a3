"""Recordings of a server (FORECAST_RECORD): their calls, one by one."""

from collections.abc import Iterator
from os import PathLike
from pathlib import Path

try:
    from mcap.exceptions import EndOfFile, McapError
    from mcap.records import Channel, Message
    from mcap.stream_reader import CRCValidationError, StreamReader
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        'recordings need mcap: pip install "cab-forecast[record]"', name=error.name
    ) from error

from google.protobuf.message import DecodeError

from cab.forecast.v1.prediction_service_pb2 import SceneRaster
from cab.forecast.v1.recording_pb2 import RecordedCall, RecordedMap

CALLS = "/forecast/call"
"""Topic of the recorded calls."""
MAPS = "/forecast/map"
"""Topic of their maps."""


def read_recording(path: str | PathLike[str]) -> Iterator[RecordedCall]:
    """Yield the calls of a file in their order, each with the map in its request.

    A file that a killed server left without an end is read as far as it goes.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no recording, or damaged.
    """
    topics: dict[int, str] = {}
    maps: dict[str, SceneRaster] = {}
    try:
        with Path(path).open("rb") as file:
            for record in StreamReader(file, validate_crcs=True).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message) and topics[record.channel_id] == MAPS:
                    recorded = RecordedMap.FromString(record.data)
                    maps[recorded.digest] = recorded.scene_raster
                elif isinstance(record, Message) and topics[record.channel_id] == CALLS:
                    yield _with_map(RecordedCall.FromString(record.data), maps)
    except EndOfFile:
        pass
    except (McapError, CRCValidationError, DecodeError, KeyError) as error:
        raise ValueError(f"{path} is no recording, or damaged: {error}") from error
    if CALLS not in topics.values():
        raise ValueError(f"{path} holds no recorded call")


def _with_map(call: RecordedCall, maps: dict[str, SceneRaster]) -> RecordedCall:
    """Put the map back into the request of a call.

    Raises:
        KeyError: the file does not hold the map.
    """
    if call.map_digest:
        call.request.scene_raster.CopyFrom(maps[call.map_digest])
    return call
