"""Rasters by digest in one process: verified, decoded once, kept within the budget."""

import asyncio
import threading
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from typing import Any

import numpy as np
import pytest

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.digest import raster_digest
from model.scenes.scene import Raster
from service.errors import BadField, UnknownRaster
from service.predict.rasters.library import RasterLibrary
from service.predict.request import decode_raster
from service.telemetry.metrics import Metrics
from tests.service.fakes import FakeForecaster
from tests.service.predict.test_pipeline import opened
from tests.service.requests import make_request, pack, png
from tests.service.servers import settings

SIZE = 40
BYTES = 3 * SIZE * SIZE
"""Size of a decoded raster."""


def whole(seed: int = 0, encoding: str = "packed_bits") -> pb.SceneRaster:
    """Return a raster with its digest."""
    layers = np.random.default_rng(seed).integers(0, 2, (3, SIZE, SIZE), dtype=np.uint8)
    raster = pb.SceneRaster(origin_x=-20.0, origin_y=3.5, pixels_per_meter=1.0)
    if encoding == "png":
        raster.image.png = png(layers)
    else:
        raster.image.packed_bits = pack(layers)
        raster.rows = raster.columns = SIZE
    raster.digest = raster_digest(raster)
    return raster


def named(raster: pb.SceneRaster) -> pb.SceneRaster:
    """Return the digest of a raster alone."""
    return pb.SceneRaster(digest=raster.digest)


class Opened(RasterLibrary):
    """A library with its metrics."""

    metrics: Metrics

    def lookups(self, source: str) -> float | None:
        return self.metrics.registry.get_sample_value("forecast_raster_lookups_total", {"source": source})

    def value(self, name: str) -> float | None:
        return self.metrics.registry.get_sample_value(name)


@asynccontextmanager
async def library(**values: Any) -> AsyncIterator[Opened]:
    with ThreadPoolExecutor(4) as threads:
        metrics = Metrics()
        made = Opened(settings(**values), metrics, threads)
        made.metrics = metrics
        try:
            yield made
        finally:
            await made.close()


async def found(rasters: RasterLibrary, message: pb.SceneRaster) -> Raster:
    raster = await rasters.find(message, 10.0)
    assert raster is not None
    return raster


@pytest.mark.parametrize("encoding", ["packed_bits", "png"])
async def test_named_after_it_was_sent(encoding: str) -> None:
    sent = whole(encoding=encoding)
    async with library() as rasters:
        first = await found(rasters, sent)
        assert await found(rasters, named(sent)) is first
        assert await found(rasters, sent) is first
        assert (first.origin.tolist(), first.pixels_per_meter) == ([-20.0, 3.5], 1.0)
        assert (rasters.lookups("sent"), rasters.lookups("memory")) == (2, 1)
        assert rasters.value("forecast_raster_bytes") == BYTES
        with pytest.raises(ValueError, match="read-only"):
            first.layers[0] = 0


async def test_without_a_digest_nothing_is_kept() -> None:
    sent = whole()
    without = pb.SceneRaster()
    without.CopyFrom(sent)
    without.ClearField("digest")
    async with library() as rasters:
        assert await rasters.find(without, 10.0) is None
        assert await rasters.find(pb.SceneRaster(), 10.0) is None
        with pytest.raises(UnknownRaster, match=sent.digest.hex()):
            await rasters.find(named(sent), 10.0)
        assert rasters.lookups("unknown") == 1


async def test_the_least_recently_used_is_unknown_again() -> None:
    a, b, c = (whole(seed) for seed in range(3))
    async with library(max_kept_raster_bytes=2 * BYTES) as rasters:
        for sent in (a, b, named(a), c):
            await found(rasters, sent)
        with pytest.raises(UnknownRaster):
            await rasters.find(named(b), 10.0)
        for kept in (a, c):
            await found(rasters, named(kept))
        assert rasters.value("forecast_rasters_dropped_total") == 1
        assert rasters.value("forecast_raster_bytes") == 2 * BYTES


async def test_without_a_budget_whole_rasters_are_served() -> None:
    sent = whole()
    async with library(max_kept_raster_bytes=0) as rasters:
        assert (await found(rasters, sent)).layers.shape == (3, SIZE, SIZE)
        with pytest.raises(UnknownRaster):
            await rasters.find(named(sent), 10.0)


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"digest": bytes(32)}, "scene_raster.digest"),
        ({"digest": b"short"}, "scene_raster.digest"),
        ({"origin_x": -20.5}, "scene_raster.digest"),
        ({"rows": 20, "columns": 80}, "scene_raster.digest"),
        ({"image": pb.LayerImage()}, "scene_raster.image"),
    ],
)
async def test_a_wrong_digest_is_a_bad_field(values: dict[str, Any], field: str) -> None:
    sent = whole()
    for name, value in values.items():
        if isinstance(value, pb.LayerImage):
            sent.image.CopyFrom(value)
        else:
            setattr(sent, name, value)
    async with library() as rasters:
        with pytest.raises(BadField) as caught:
            await rasters.find(sent, 10.0)
        assert caught.value.faults[0].field == field
        assert rasters.value("forecast_raster_bytes") == 0


async def test_an_invalid_raster_is_refused_and_not_kept() -> None:
    sent = whole()
    sent.pixels_per_meter = 1000.0
    sent.digest = raster_digest(sent)
    async with library() as rasters:
        for _ in range(2):
            with pytest.raises(BadField, match="pixels_per_meter"):
                await rasters.find(sent, 10.0)
        with pytest.raises(UnknownRaster):
            await rasters.find(named(sent), 10.0)


@pytest.mark.parametrize("name", ["rows", "origin_x", "pixels_per_meter"])
async def test_beside_a_digest_alone_nothing_is_given(name: str) -> None:
    message = named(whole())
    setattr(message, name, 2)
    async with library() as rasters:
        with pytest.raises(BadField, match=rf"scene_raster\.{name}: must be left out"):
            await rasters.find(message, 10.0)


async def test_calls_with_the_same_new_raster_decode_it_once(monkeypatch: pytest.MonkeyPatch) -> None:
    sent, decoded, proceed = whole(), [], threading.Event()

    def slow(*arguments: Any) -> Raster:
        decoded.append(arguments)
        assert proceed.wait(10)
        return decode_raster(*arguments)

    monkeypatch.setattr("service.predict.rasters.library.decode_raster", slow)
    async with library() as rasters:
        calls = [asyncio.create_task(found(rasters, sent)) for _ in range(3)]
        async with asyncio.timeout(10):
            while not decoded:  # noqa: ASYNC110 - no event tells
                await asyncio.sleep(0.001)
        calls.append(asyncio.create_task(found(rasters, named(sent))))
        await asyncio.sleep(0)
        calls[0].cancel()  # the others must get it all the same
        await asyncio.gather(calls[0], return_exceptions=True)
        proceed.set()
        first, *others = await asyncio.gather(*calls[1:])
        assert all(other is first for other in others)
        assert len(decoded) == 1


async def test_the_kept_array_is_the_scenes_own() -> None:
    fake = FakeForecaster(uses_map=True)
    request = make_request(2)
    request.scene_raster.CopyFrom(whole())
    async with opened(fake) as plane:
        await plane.predict(request)
        request.scene_raster.CopyFrom(named(request.scene_raster))
        await plane.predict(request)
        await plane.predict(request)
    first, *others = [scene.raster for scene in fake.scenes]
    assert first is not None
    assert all(other is first for other in others)
    assert len(others) == 2


async def test_an_unknown_raster_leaves_no_place_taken() -> None:
    request = make_request(2)
    request.scene_raster.digest = bytes(32)
    async with opened(FakeForecaster(), max_agents=2, max_queue_agents=2) as plane:
        for _ in range(3):
            with pytest.raises(UnknownRaster):
                await plane.predict(request)
        request.ClearField("scene_raster")
        assert len((await plane.predict(request)).forecasts) == 2
