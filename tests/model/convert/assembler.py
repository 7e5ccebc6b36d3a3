"""Writes pickles opcode by opcode, and torch's legacy files around them, honest or not."""

import pickle
import struct
from collections.abc import Mapping, Sequence

import numpy as np

from model.arrays import Float32s

MAGIC = 0x1950A86A20F9469CFC6C
SYSTEM = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}
NONE, EMPTY_TUPLE = b"N", b")"


def text(value: str) -> bytes:
    encoded = value.encode()
    return b"X" + struct.pack("<I", len(encoded)) + encoded


def number(value: int) -> bytes:
    return b"\x8b" + struct.pack("<i", 9) + value.to_bytes(9, "little", signed=True)


def named(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def group(*items: bytes) -> bytes:
    return b"(" + b"".join(items) + b"t"


def mapping(items: Mapping[str, bytes]) -> bytes:
    return b"}(" + b"".join(text(key) + value for key, value in items.items()) + b"u"


def call(function: bytes, *arguments: bytes) -> bytes:
    return function + group(*arguments) + b"R"


def program(body: bytes) -> bytes:
    return b"\x80\x02" + body + b"."


def storage(key: str, count: int, kind: bytes = named("torch", "FloatStorage"), view: bytes = NONE) -> bytes:
    return group(text("storage"), kind, text(key), text("cpu"), number(count), view) + b"Q"


def tensor(storage_: bytes, size: Sequence[int], stride: Sequence[int], offset: int = 0) -> bytes:
    shape = (group(*map(number, size)), group(*map(number, stride)))
    rebuilt = call(
        named("torch._utils", "_rebuild_tensor_v2"), storage_, number(offset), *shape, b"\x89", b"}"
    )
    return call(named("torch._utils", "_rebuild_parameter"), rebuilt, b"\x88", b"}")


def module(
    parameters: Mapping[str, bytes] | None = None,
    modules: Mapping[str, bytes] | None = None,
    buffers: Mapping[str, bytes] | None = None,
    kind: bytes = named("torch.nn.modules.linear", "Linear"),
) -> bytes:
    parts = {
        "_parameters": mapping(parameters or {}),
        "_modules": mapping(modules or {}),
        "_buffers": mapping(buffers or {}),
    }
    return kind + EMPTY_TUPLE + b"\x81" + mapping(parts) + b"b"


def legacy_file(
    body: bytes,
    storages: Mapping[str, Float32s] | None = None,
    magic: object = MAGIC,
    version: object = 1001,
    system: object = SYSTEM,
) -> bytes:
    storages = storages or {}
    head = b"".join(pickle.dumps(value, protocol=2) for value in (magic, version, system))
    tail = b"".join(struct.pack("<q", array.size) + array.tobytes() for array in storages.values())
    return head + program(body) + pickle.dumps(list(storages), protocol=2) + tail


def linear() -> tuple[bytes, dict[str, Float32s]]:
    """A module within a module, and its storages: weight [2, 3] transposed, bias [2] at an offset."""
    storages = {
        "w": np.arange(6, dtype=np.float32),
        "b": np.array([9, 8, 7, 6], dtype=np.float32),
    }
    parameters = {
        "weight": tensor(storage("w", 6), (2, 3), (1, 2)),
        "bias": tensor(storage("b", 4), (2,), (1,), offset=1),
        "nothing": NONE,
    }
    container = named("torch.nn.modules.container", "ModuleDict")
    return module(modules={"NODE/part": module(parameters)}, kind=container), storages
