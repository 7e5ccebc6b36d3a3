"""Cases run through the service's pipeline in this process."""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Self

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab_forecast import forecasts
from model.checkpoint import load_checkpoint
from model.forecaster import Forecaster, ModelInfo
from model.registry import Registry, load_checkpoints
from service.predict.dataplane import DataPlane
from service.settings import bundled_models
from service.telemetry.metrics import Metrics
from tests.cases.case import CAR, Case
from tests.cases.checks import LocalForecast
from tests.service.fakes import registry
from tests.service.servers import settings

_AT_ONCE = 16
"""Max calls in flight."""


def bundled(name: str) -> Forecaster:
    """Return a bundled model, by ``name`` or ``name@version``."""
    return Registry.load(bundled_models(), allow_paper=True).get(name)


def network_frame(info: ModelInfo) -> str:
    """Return the frame of a bundled model's network: "agent" or "ground".

    Raises:
        ValueError: the model has no checkpoint.
    """
    folder = bundled_models()
    for checkpoint in () if folder is None else load_checkpoints(folder):
        if checkpoint.info == info:
            return str(getattr(checkpoint.network, "frame", "ground"))
    raise ValueError(f"{info.full_name} has no bundled checkpoint")


def from_checkpoint(folder: Path) -> Forecaster:
    """Return the model in a checkpoint's folder."""
    return load_checkpoint(folder).forecaster()


class Served:
    """A context manager: a model in the service's pipeline, with the baselines as its fallbacks."""

    def __init__(self, forecaster: Forecaster) -> None:
        self.info = forecaster.info
        """The model's info."""
        self._forecaster = forecaster
        self._runner = asyncio.Runner()
        own = settings(default_model=forecaster.info.name, max_batch_agents=_AT_ONCE)
        self._plane = DataPlane(own, Metrics())

    def __enter__(self) -> Self:
        self._runner.run(self._plane.open(self._load))
        return self

    def __exit__(self, *_: object) -> None:
        self._runner.run(self._plane.close())
        self._runner.close()

    def _load(self, _: object) -> Registry:
        """Return the baselines and the model, which may be one of them."""
        alone = registry()
        return alone if self.info in alone.infos() else registry(self._forecaster)

    def answer(self, cases: Sequence[Case]) -> list[LocalForecast]:
        """Return the forecast of each case's car, from request to response as in the server.

        Raises:
            ValueError: a car has no forecast.
        """
        responses = self._runner.run(self._predict([case.request for case in cases]))
        found = []
        for case, response in zip(cases, responses, strict=True):
            forecast = forecasts(response)[CAR]
            if not len(forecast.weights):
                raise ValueError(f"{case.name}: {forecast.status}, {forecast.field}: {forecast.detail}")
            found.append(LocalForecast.of(forecast, case.frame))
        return found

    async def _predict(self, requests: Sequence[pb.PredictRequest]) -> list[pb.PredictResponse]:
        turn = asyncio.Semaphore(_AT_ONCE)

        async def one(request: pb.PredictRequest) -> pb.PredictResponse:
            async with turn:
                return await self._plane.predict(request)

        return await asyncio.gather(*(one(request) for request in requests))
