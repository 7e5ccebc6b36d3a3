"""One answered call on its way to the recording, and its message there."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1 import recording_pb2 as recording
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


def recorded_call(call: AnsweredCall, map_digest: str, server_version: str) -> recording.RecordedCall:
    """Return the message of a call.

    Args:
        call: the call.
        map_digest: the digest of its scene raster; empty if there is none.
        server_version: the version of the server.
    """
    message = recording.RecordedCall(
        request=call.request,
        response=call.response,
        map_digest=map_digest,
        recalled=[
            recording.RecalledHistory(agent_id=agent_id, states=recalled_states(history))
            for agent_id, history in call.histories.items()
            if history
        ],
        server_version=server_version,
    )
    if map_digest:
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
