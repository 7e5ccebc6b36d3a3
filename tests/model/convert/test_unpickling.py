import contextlib
import io
import os
import pickle
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.convert.errors import ConversionError, UnsafePickleError
from model.convert.unpickling import TORCH_MODULES, InertModule, StorageRef, unpickle
from tests.model.convert.assembler import call, group, module, named, number, program, storage, text


def _read(data: bytes) -> object:
    return unpickle(io.BytesIO(data), TORCH_MODULES)


class _Bomb:
    """Leaves a file behind when unpickled."""

    def __init__(self, function: Any, *arguments: object) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> tuple[Any, tuple[object, ...]]:
        return self.call


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("nested", [False, True])
def test_nothing_is_run_at_any_protocol(tmp_path: Path, protocol: int, nested: bool) -> None:
    witness = tmp_path / "ran"
    bomb: object = _Bomb(os.mkdir, str(witness))
    if nested:
        bomb = {"a": [1, (2, {"b": bomb})]}
    data = pickle.dumps(bomb, protocol=protocol)
    with pytest.raises(UnsafePickleError, match=rf"names {os.name}\.mkdir"):
        _read(data)
    assert not witness.exists()
    pickle.loads(data)  # noqa: S301 (the bomb is a real one)
    assert witness.exists()


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        ("os", "system"),
        ("posix", "system"),
        ("subprocess", "Popen"),
        ("builtins", "eval"),
        ("builtins", "exec"),
        ("builtins", "getattr"),
        ("__builtin__", "eval"),
        ("torch.hub", "load"),
        ("torch", "load"),
        ("torch", "DoubleStorage"),
        ("torch.nn.modules.linear", "Linear.__init__"),
        ("torch.nn.modules.linear", "os"),
        ("collections", "OrderedDict.fromkeys"),
        ("torch._utils", "_rebuild_tensor_v2.__globals__"),
        ("model.convert.unpickling", "unpickle"),
    ],
)
@pytest.mark.parametrize("spelled", ["GLOBAL", "STACK_GLOBAL", "INST", "persistent id"])
def test_every_name_outside_the_list_is_refused(owner: str, name: str, spelled: str) -> None:
    body = {
        "GLOBAL": call(named(owner, name), text("true")),
        "STACK_GLOBAL": text(owner) + text(name) + b"\x93" + group(text("true")) + b"R",
        "INST": b"(" + text("true") + f"i{owner}\n{name}\n".encode(),
        "persistent id": group(text("module"), named(owner, name), text(""), text("")) + b"Q",
    }[spelled]
    with pytest.raises(UnsafePickleError) as caught:
        _read(program(body))
    assert f"{owner}.{name}" in str(caught.value)


@pytest.mark.parametrize("opcode", [b"\x82\x01", b"\x83\x01\x00", b"\x84\x01\x00\x00\x00"])
def test_extension_codes_are_refused(opcode: bytes) -> None:
    with pytest.raises(UnsafePickleError, match="extension code 1"):
        _read(program(opcode))


@pytest.mark.parametrize(
    "body",
    [
        b"r" + (2**31 - 1).to_bytes(4, "little"),  # LONG_BINPUT: the memo would take gigabytes
        b"p2147483647\n",
    ],
)
def test_a_memo_without_bound_is_refused(body: bytes) -> None:
    with pytest.raises(ConversionError, match="memo of 2147483647 entries"):
        _read(program(b"N" + body))


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x80",
        b"\x80\x02",
        b"hello",
        program(b""),
        program(b"R"),
        program(b"h\x05"),
        program(b"\x8d" + (2**60).to_bytes(8, "little")),  # a string of an exabyte
        program(b"\x96" + (2**60).to_bytes(8, "little")),  # bytes
        program(b"\x8b\xff\xff\xff\x7f"),  # a number of two gigabytes
        program(b"X\xff\xff\xff\xffa"),
        program(b"\x97"),  # a buffer that is nowhere
        program(b"]" * 3 + b"b"),
        program(b"0"),
        b"\x80\xff.",
    ],
)
def test_damaged_pickles(data: bytes) -> None:
    with pytest.raises(ConversionError):
        _read(data)


@given(st.binary(max_size=60))
def test_noise_is_refused_or_harmless(noise: bytes) -> None:
    with contextlib.suppress(ConversionError):
        _read(noise)


@given(st.integers(0, 2**16), st.integers(0, 255))
def test_flipped_bytes_are_refused_or_harmless(place: int, value: int) -> None:
    data = bytearray(program(module({"weight": storage("k", 3)})))
    data[place % len(data)] = value
    with contextlib.suppress(ConversionError):
        _read(bytes(data))


def test_modules_become_inert() -> None:
    read = _read(program(module({"weight": storage("k", 3)})))
    assert isinstance(read, InertModule)
    assert read.state == {"_parameters": {"weight": StorageRef("k", 3)}, "_modules": {}, "_buffers": {}}


@pytest.mark.parametrize("name", [name for name, meaning in TORCH_MODULES.items() if meaning is InertModule])
def test_modules_take_no_arguments_and_only_dictionaries(name: str) -> None:
    owner, _, cls = name.partition(" ")
    for body in (
        call(named(owner, cls), number(1)),
        named(owner, cls) + group(number(1)) + b"\x81",
        named(owner, cls) + b")\x81" + number(1) + b"b",
    ):
        with pytest.raises(ConversionError):
            _read(program(body))


@pytest.mark.parametrize(
    "pid",
    [
        number(3),
        text("storage"),
        group(
            text("storage"),
            named("torch.nn.modules.linear", "Linear"),
            text("k"),
            text("cpu"),
            number(1),
            b"N",
        ),
        group(text("storage"), named("torch", "FloatStorage"), text("k"), text("cpu"), text("1"), b"N"),
        group(text("storage"), named("torch", "FloatStorage"), text("k"), text("cpu"), number(1), group()),
        group(text("other"), named("torch", "FloatStorage"), text(""), text("")),
    ],
)
def test_other_outside_references_are_refused(pid: bytes) -> None:
    with pytest.raises(ConversionError, match="neither a class nor a float32 storage"):
        _read(program(pid + b"Q"))


def test_only_the_first_pickle_of_a_stream_is_read() -> None:
    stream = io.BytesIO(pickle.dumps(1, 2) + pickle.dumps("two", 2) + b"rest")
    assert unpickle(stream, {}) == 1
    assert unpickle(stream, {}) == "two"
    assert stream.read() == b"rest"
