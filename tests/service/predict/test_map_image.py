"""Map layers: what is accepted comes out bit for bit, and nothing else is accepted."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cab.forecast.v1 import prediction_service_pb2 as pb
from model.arrays import Bytes
from service.errors import BadField
from service.predict.map_image import decode_layers
from tests.service.requests import pack, png
from tests.service.timing import cpu_seconds

MAX = 10_000


def layers(rows: int, columns: int) -> Bytes:
    return (np.random.default_rng(rows + columns).random((3, rows, columns)) > 0.5).astype(np.uint8)


def decode(
    image: pb.LayerImage, rows: int | None = None, columns: int | None = None, max_pixels: int = MAX
) -> Bytes:
    return decode_layers(image, "image", rows, columns, max_pixels)


def refusal(image: pb.LayerImage, rows: int | None = None, columns: int | None = None) -> str:
    with pytest.raises(BadField) as caught:
        decode(image, rows, columns)
    [fault] = caught.value.faults
    assert fault.field.startswith("image")
    return fault.detail


@pytest.mark.parametrize("size", [(1, 1), (3, 7), (8, 8), (100, 100)])
def test_both_encodings_give_the_bits(size: tuple[int, int]) -> None:
    expected = layers(*size)
    assert np.array_equal(decode(pb.LayerImage(packed_bits=pack(expected)), *size), expected)
    assert np.array_equal(decode(pb.LayerImage(png=png(expected)), *size), expected)
    assert np.array_equal(decode(pb.LayerImage(png=png(expected))), expected)


def test_order_of_bits() -> None:
    decoded = decode(pb.LayerImage(packed_bits=bytes([0b1000_0001, 0b0000_0000])), 2, 2)
    assert np.flatnonzero(decoded).tolist() == [0, 7]  # [layer, row, column], the highest bit first


def test_packed_sizes_are_checked() -> None:
    assert "need 150 bytes, got 149" in refusal(pb.LayerImage(packed_bits=bytes(149)), 20, 20)
    assert "zeros" in refusal(pb.LayerImage(packed_bits=bytes([0b1110_0001])), 1, 1)
    assert "rows and columns" in refusal(pb.LayerImage(packed_bits=bytes(150)))


def test_nothing_is_refused() -> None:
    assert refusal(pb.LayerImage()) == "give packed_bits or png"


@pytest.mark.parametrize("mode", ["RGBA", "L", "1", "P"])
def test_other_kinds_of_png_are_refused(mode: str) -> None:
    assert refusal(pb.LayerImage(png=png(layers(4, 4), mode=mode))) == "must be 8-bit RGB without alpha"


@pytest.mark.parametrize("kind", ["JPEG", "BMP", "TIFF", "WEBP"])
def test_other_formats_are_refused(kind: str) -> None:
    assert refusal(pb.LayerImage(png=png(layers(8, 8), kind=kind))) == "is not a PNG"


def test_sizes_are_checked() -> None:
    image = pb.LayerImage(png=png(layers(4, 5)))
    assert refusal(image, 5, 4) == "is 4 × 5 pixels, expected 5 × 4"
    assert refusal(image, 3, None) == "is 4 × 5 pixels, expected 3 × any"
    with pytest.raises(BadField, match="1 to 19 are accepted"):
        decode(image, max_pixels=19)


def test_a_bomb_is_refused_for_what_it_says() -> None:
    assert "are accepted" in refusal(pb.LayerImage(png=_raw_png(60_000, 60_000, b"\0" * 1000)))


def test_a_png_that_holds_less_than_it_says_is_refused() -> None:
    assert "cannot be decoded" in refusal(pb.LayerImage(png=_raw_png(100, 100, b"\0" * 10)))


def test_a_png_that_holds_more_than_it_says_is_cut_off() -> None:
    bomb = _raw_png(2, 2, b"\0" * 10_000_000)
    assert decode(pb.LayerImage(png=bomb), 2, 2).shape == (3, 2, 2)


def test_a_bomb_of_pixels_costs_nothing() -> None:
    packer = zlib.compressobj(9)
    squeezed = b"".join([*(packer.compress(bytes(2**20)) for _ in range(500)), packer.flush()])
    bomb = _png_of(_header(2, 2), (b"IDAT", squeezed), (b"IEND", b""))
    assert _seconds(bomb, 2, 2) < 0.1


@pytest.mark.parametrize("name", [b"zTXt", b"iTXt", b"iCCP"])
def test_texts_and_profiles_cost_nothing(name: bytes) -> None:
    zeros = zlib.compress(bytes(2**20))
    contents = {
        b"zTXt": b"key\0\0" + zeros,
        b"iTXt": b"key\0\1\0\0\0" + zeros,
        b"iCCP": b"key\0\0" + zeros,
    }
    png = _png_of(_header(2, 2), *[(name, contents[name])] * 62, _pixels(2, 2), (b"IEND", b""))
    assert _seconds(png, 2, 2) < 0.05  # 0.15 s where they are unpacked


def test_what_is_no_pixels_changes_nothing() -> None:
    png = _png_of(
        _header(2, 2),
        (b"PLTE", bytes(6)),
        (b"acTL", bytes(8)),
        (b"tEXt", b"key\0text"),
        (b"tEXt", b"\0"),
        _pixels(2, 2, 255),
        (b"tIME", bytes(7)),
        (b"IEND", b""),
    )
    assert decode(pb.LayerImage(png=png + b"and more"), 2, 2).all()


def test_chunks_are_bounded() -> None:
    pixels = _pixels(2, 2)
    many = _png_of(_header(2, 2), *[(b"tEXt", b"")] * 300, pixels, (b"IEND", b""))
    assert refusal(pb.LayerImage(png=many)) == "cannot be decoded: has more than 259 chunks"
    assert refusal(pb.LayerImage(png=_png_of(_header(2, 2), pixels))) == "cannot be decoded: is cut off"
    overlong = _png_of(_header(2, 2)) + b"\xff\xff\xff\xffIDAT"
    assert refusal(pb.LayerImage(png=overlong)) == "cannot be decoded: is cut off"
    rows = [(b"IDAT", pixels[1][index : index + 1]) for index in range(len(pixels[1]))]
    assert not decode(pb.LayerImage(png=_png_of(_header(2, 2), *rows, (b"IEND", b"")))).any()


@given(st.data())
def test_broken_bytes_never_do_harm(data: st.DataObject) -> None:
    good = bytearray(png(layers(5, 5)))
    for _ in range(data.draw(st.integers(1, 4))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(good[: data.draw(st.integers(0, len(good)))])
    try:
        decoded = decode(pb.LayerImage(png=cut))
    except BadField:
        return
    assert decoded.max(initial=0) <= 1


def _seconds(png: bytes, rows: int, columns: int) -> float:
    """CPU time that it takes to decode."""
    assert decode(pb.LayerImage(png=png), rows, columns).shape == (3, rows, columns)
    return cpu_seconds(lambda: decode(pb.LayerImage(png=png), rows, columns))


def _header(width: int, height: int) -> tuple[bytes, bytes]:
    return b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)


def _pixels(width: int, height: int, value: int = 0) -> tuple[bytes, bytes]:
    row = b"\0" + bytes([value]) * (3 * width)
    return b"IDAT", zlib.compress(row * height)


def _raw_png(width: int, height: int, pixels: bytes) -> bytes:
    return _png_of(_header(width, height), (b"IDAT", zlib.compress(pixels)), (b"IEND", b""))


def _png_of(*chunks: tuple[bytes, bytes]) -> bytes:
    parts = [
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        for name, body in chunks
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
