"""The metrics that a running server exports: names, labels and label values."""

import re
from collections.abc import Mapping

import numpy as np
from prometheus_client.parser import text_string_to_metric_families

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab_forecast import scene_raster
from service import errors
from service.server import Server
from service.tracking.store.failures import FailureReason
from tests.service.fakes import FakeForecaster
from tests.service.requests import make_request
from tests.service.servers import call_grpc, call_rest, running
from tests.service.tracking.store.stores import scene_name
from tests.service.tracks import made_up

Labels = dict[str, set[str]]
"""The values of each label."""
Series = Mapping[str, Labels]
"""The labels of each series, by name."""

_PATIENT = {"store_budget_ms": 5000.0, "store_timeout_ms": 5000.0}
_NOWHERE = "redis://127.0.0.1:1"
_MODEL = "fake"


async def exported() -> dict[str, Labels]:
    """Return all series of two servers: one that forecast agents until sets settled, one without a store.

    Labels that name failures have all their possible values.
    """
    found: dict[str, Labels] = {}
    tracks = made_up(scene_name(), agents=2)
    async with running(FakeForecaster(_MODEL), **_PATIENT) as server:
        for frame in tracks.frames():
            call = call_rest if frame % 2 else call_grpc
            await call(server, tracks.request(frame, _MODEL))
        await call_grpc(server, _off_the_road())
        _add(found, server)
    async with running(FakeForecaster(_MODEL), store=_NOWHERE, **_PATIENT) as server:
        await call_grpc(server, tracks.request(1, _MODEL))
        # These servers have neither a shadow model nor keys
        server.metrics.shadow_calls.labels(_MODEL, "done")
        keys = server.metrics.keys
        keys.requests.labels("planner", "OK")
        keys.agents.labels("planner")
        keys.refused.labels("planner", "rate")
        _add(found, server)
    found["forecast_track_store_errors_total"]["reason"].update(FailureReason)
    kinds = [kind for kind in vars(errors).values() if isinstance(kind, type)]
    codes = {kind.code for kind in kinds if issubclass(kind, errors.ServiceError)}
    found["forecast_requests_total"]["code"].update(codes)
    return found


def _off_the_road() -> pb.PredictRequest:
    """Return a request with a driving agent on a map without a road."""
    request = make_request(1, _MODEL)
    request.scene_raster.CopyFrom(scene_raster(np.zeros((3, 300, 300), dtype=np.uint8), (-50.0, -50.0)))
    return request


def _add(found: dict[str, Labels], server: Server) -> None:
    for family in text_string_to_metric_families(server.metrics.render().decode()):
        for sample in family.samples:
            labels = found.setdefault(sample.name, {"job": set(), "instance": set()})  # added by Prometheus
            for name, value in sample.labels.items():
                labels.setdefault(name, set()).add(value)


def is_known(value: str, labels: Labels, name: str) -> bool:
    """Return whether a label can have a value, or each of the alternatives in a | b | c."""
    return not labels[name] or all(
        any(re.fullmatch(part, known) for known in labels[name]) for part in value.split("|")
    )
