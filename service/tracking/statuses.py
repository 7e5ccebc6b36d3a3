"""What became of a memory, in the contract's words."""

from cab.forecast.v1 import consistency_service_pb2 as pb
from service.tracking.store.base import Event, Fate

OF_AGENT = {
    Fate.KEPT: pb.TRACKING_STATUS_OK,
    Fate.NEW: pb.TRACKING_STATUS_NEW,
    Fate.RESET: pb.TRACKING_STATUS_RESET,
}
OF_SCENE = {
    Event.KEPT: pb.TRACKING_STATUS_OK,
    Event.BEGUN: pb.TRACKING_STATUS_NEW,
    Event.LOST: pb.TRACKING_STATUS_RESET,
}
