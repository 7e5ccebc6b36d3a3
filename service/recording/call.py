"""One answered call on its way to the recording, and its message there."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1 import recording_pb2 as recording
from cab.forecast.v1.digest import raster_digest
from model.scenes.scene import Raster
from service.tracking.store.records import split_observations

_STATE_FIELDS = [field.name for field in pb.AgentState.DESCRIPTOR.fields]


@dataclass(frozen=True)
class AnsweredCall:
    """An answered call. Its messages are not changed any more."""

    request: pb.PredictRequest
    response: pb.PredictResponse
    raster: Raster | None
    """Decoded map of the request."""
    histories: Mapping[str, bytes]
    """Histories from the track memory, by agent id; see ``service.tracking.store.records``."""
    time_ns: int
    """Time of the answer, ns since the epoch."""

    @property
    def size(self) -> int:
        """Bytes that the call needs about in memory."""
        raster = 0 if self.raster is None else self.raster.layers.nbytes
        histories = sum(map(len, self.histories.values()))
        return self.request.ByteSize() + self.response.ByteSize() + raster + histories


def map_digest(request: pb.PredictRequest) -> str:
    """Return the digest of a request's scene raster, hexadecimal; empty if it has none."""
    if not request.HasField("scene_raster"):
        return ""
    return (request.scene_raster.digest or raster_digest(request.scene_raster)).hex()


def recorded_map(call: AnsweredCall, digest: str) -> recording.RecordedMap:
    """Return the message of a call's map; one that the request names by its digest alone is in it, too."""
    message = recording.RecordedMap(digest=digest, scene_raster=call.request.scene_raster)
    raster = message.scene_raster
    raster.ClearField("digest")
    if not raster.HasField("image") and call.raster is not None:
        _, raster.rows, raster.columns = call.raster.layers.shape
        raster.origin_x, raster.origin_y = call.raster.origin.tolist()
        raster.pixels_per_meter = call.raster.pixels_per_meter
        raster.image.packed_bits = np.packbits(call.raster.layers).tobytes()
    return message


def recorded_call(call: AnsweredCall, digest: str, server_version: str) -> recording.RecordedCall:
    """Return the message of a call.

    Args:
        call: the call.
        digest: the digest of its scene raster; empty if there is none.
        server_version: the version of the server.
    """
    message = recording.RecordedCall(
        request=call.request,
        response=call.response,
        map_digest=digest,
        recalled=[
            recording.RecalledHistory(agent_id=agent_id, states=recalled_states(history))
            for agent_id, history in call.histories.items()
            if history
        ],
        server_version=server_version,
    )
    if digest:
        message.request.scene_raster.ClearField("image")
    return message


def recalled_states(history: bytes) -> list[pb.AgentState]:
    """Return the observations of one history from the track memory as states."""
    return [
        pb.AgentState(
            **{name: value for name, value in zip(_STATE_FIELDS, row, strict=True) if not math.isnan(value)}
        )
        for row in split_observations(history)
    ]
