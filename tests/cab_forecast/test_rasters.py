"""Rasters that the server has are named by their digest; clients send those that it lacks by themselves."""

import hashlib
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cab.forecast.v1.prediction_service_pb2 import LayerImage, PredictRequest, SceneRaster
from cab_forecast import (
    AsyncClient,
    Client,
    UnknownRaster,
    agent,
    predict_request,
    raster_digest,
    scene_raster,
)
from cab_forecast.rasters import MIN_IMAGE_BYTES, RasterDigests, Sending
from tests.cab_forecast.fakes import Failure, Script, grpc_fake

UNKNOWN = Failure("FAILED_PRECONDITION", 412, "UNKNOWN_RASTER")
Call = Callable[..., Any]


def request(seed: int = 0, pixels: int = 120) -> PredictRequest:
    """Return a request with a raster of its own for each seed."""
    layers = np.random.default_rng(seed).integers(0, 2, (3, pixels, pixels))
    return predict_request(
        10.0,
        [agent("car", "vehicle", [9.5, 10.0], [[0, 0], [4, 0]])],
        scene_id="street",
        raster=scene_raster(layers, (-20.0, 3.5)),
        samples=3,
        seed=7,
    )


def as_sent(script: Script) -> list[str]:
    """Return how the raster of each call was sent: whole, whole with its digest, or named."""
    return [_kind(call.scene_raster) for call in script.predicted]


def _kind(raster: SceneRaster) -> str:
    if not raster.digest:
        return "plain"
    return "whole" if raster.HasField("image") else "named"


def test_the_example_of_the_contract() -> None:
    raster = SceneRaster(
        image=LayerImage(packed_bits=b"\xab\xc0"),
        rows=2,
        columns=2,
        origin_x=-1.5,
        origin_y=2.5,
        pixels_per_meter=3.0,
    )
    expected = "3e8cc400762a2b87f8d46533d038babc608ae53bc29db6a86af9e2c384719672"
    assert raster_digest(raster).hex() == expected
    raster.digest = b"it does not count"
    assert raster_digest(raster).hex() == expected


@given(
    st.sampled_from(["packed_bits", "png"]),
    st.binary(max_size=100),
    st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1)),
    st.tuples(*[st.floats(allow_nan=False)] * 3),
)
def test_the_digest_is_as_the_contract_says(
    encoding: str, image: bytes, size: tuple[int, int], geometry: tuple[float, float, float]
) -> None:
    raster = SceneRaster(rows=size[0], columns=size[1])
    raster.origin_x, raster.origin_y, raster.pixels_per_meter = geometry
    setattr(raster.image, encoding, image)
    number = {"packed_bits": b"\1", "png": b"\2"}[encoding]
    parts = [number, struct.pack("<2I", *size), struct.pack("<3d", *geometry), image]
    assert raster_digest(raster) == hashlib.sha256(b"".join(parts)).digest()


def test_a_raster_without_an_image_has_no_digest() -> None:
    with pytest.raises(ValueError, match="no digest"):
        raster_digest(SceneRaster(rows=2, columns=2))


def test_only_the_first_call_sends_the_image(script: Script, server: tuple[str, dict[str, Any]]) -> None:
    endpoint, arguments = server
    given_ = request()
    with Client(endpoint, **arguments) as client:
        for _ in range(3):
            client.predict(given_)
    assert as_sent(script) == ["whole", "named", "named"]
    first, second, _ = script.predicted
    assert (first.scene_raster.image, second.scene_raster.digest) == (
        given_.scene_raster.image,
        raster_digest(given_.scene_raster),
    )
    for sent in script.predicted:  # nothing else differs
        sent.scene_raster.CopyFrom(given_.scene_raster)
        assert sent == given_
    assert given_ == request()  # the caller's own message is as it was


async def test_asyncio_does_so_too(script: Script) -> None:
    with grpc_fake(script) as address:
        async with AsyncClient(address) as client:
            await client.predict(request())
            script.failures = [UNKNOWN]
            await client.predict(request())
            await client.predict(request())
    assert as_sent(script) == ["whole", "whole", "named"]
    assert len(script.calls) == 4


def test_an_unknown_raster_is_sent_whole_within_the_call(
    script: Script, server: tuple[str, dict[str, Any]]
) -> None:
    endpoint, arguments = server
    with Client(endpoint, retries=0, **arguments) as client:
        client.predict(request())
        script.failures = [UNKNOWN]
        client.predict(request(), timeout=2.0)
        client.predict(request())
    assert as_sent(script) == ["whole", "whole", "named"]
    assert len(script.calls) == 4
    assert float(script.calls[2]["timeout"]) < 3.0  # the budget of the call, not that of the client


def test_a_failed_call_tells_nothing_of_its_raster(script: Script) -> None:
    script.failures = [Failure("UNAVAILABLE", 503, "DRAINING", retry_after=0.0)]
    with grpc_fake(script) as address, Client(address, retries=0) as client:
        with pytest.raises(Exception, match="it went wrong"):
            client.predict(request())
        client.predict(request())
    assert as_sent(script) == ["whole"]


def test_opting_out(script: Script) -> None:
    with grpc_fake(script) as address, Client(address, map_by_digest=False) as client:
        for _ in range(2):
            client.predict(request())
    assert as_sent(script) == ["plain", "plain"]


@pytest.mark.parametrize("map_by_digest", [True, False])
def test_the_callers_own_digest_alone_fails_where_it_is_unknown(script: Script, map_by_digest: bool) -> None:
    script.failures = [UNKNOWN]
    given_ = request()
    given_.scene_raster.CopyFrom(SceneRaster(digest=bytes(32)))
    with (
        grpc_fake(script) as address,
        Client(address, map_by_digest=map_by_digest) as client,
        pytest.raises(UnknownRaster),
    ):
        client.predict(given_)
    assert len(script.calls) == 1


def test_small_rasters_and_none_are_sent_as_they_are() -> None:
    digests = RasterDigests()
    without = request()
    without.ClearField("scene_raster")
    small = request(pixels=100)
    assert len(small.scene_raster.image.packed_bits) < MIN_IMAGE_BYTES
    for given_ in (without, small):
        for _ in range(2):
            assert digests.prepare(given_) == Sending(given_)


def test_a_server_that_keeps_none_is_seldom_asked() -> None:
    digests, given_ = RasterDigests(), request()
    extra = 0
    for _ in range(200):
        sending = digests.prepare(given_)
        if sending.named:  # the server never has it
            extra += 1
            sending = digests.whole(given_, sending)
        digests.answered(sending)
    assert 3 <= extra <= 10
    # Once it keeps them, each call names the raster again
    for _ in range(80):
        sending = digests.prepare(given_)
        digests.answered(sending)
    assert all(digests.prepare(given_).named for _ in range(3))


def test_maps_that_are_cut_anew_are_sent_without_a_digest() -> None:
    digests = RasterDigests()
    kinds = []
    for seed in range(30):
        sending = digests.prepare(request(seed))
        digests.answered(sending)
        kinds.append(_kind(sending.request.scene_raster))
    assert kinds[0] == "whole"
    assert set(kinds[20:]) == {"plain"}
    for kind in ("whole", "named"):  # one of them comes again
        sending = digests.prepare(request(29))
        digests.answered(sending)
        assert _kind(sending.request.scene_raster) == kind
    assert _kind(digests.prepare(request(31)).request.scene_raster) == "whole"


def test_only_so_many_rasters_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cab_forecast.rasters._MAX_SEEN", 3)
    digests = RasterDigests()
    for seed in range(4):
        digests.answered(digests.prepare(request(seed)))
    assert digests.prepare(request(3)).named
    assert not digests.prepare(request(0)).named
