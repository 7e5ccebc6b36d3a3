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
from model.convert.inert import MAX_NAME_LENGTH, Named, TensorRef
from model.convert.unpickling import (
    MAX_INT_BITS,
    MAX_MARKS,
    MAX_TUPLE_ITEMS,
    TORCH_MODULES,
    InertModule,
    StorageRef,
    unpickle,
)
from tests.model.convert.assembler import (
    call,
    group,
    mapping,
    module,
    named,
    number,
    program,
    storage,
    tensor,
    text,
)

LINEAR = named("torch.nn.modules.linear", "Linear")
ORDERED_DICT = named("collections", "OrderedDict")
REBUILD = named("torch._utils", "_rebuild_tensor_v2")
REBUILD_PARAMETER = named("torch._utils", "_rebuild_parameter")
FLOAT_STORAGE = named("torch", "FloatStorage")


def _read(data: bytes) -> object:
    return unpickle(io.BytesIO(data), TORCH_MODULES)


def _fault(body: bytes) -> str:
    with pytest.raises(ConversionError) as caught:
        _read(program(body))
    return str(caught.value)


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


def test_an_ordered_dictionary_is_made_empty_and_filled() -> None:
    assert _read(program(ORDERED_DICT + b")R(" + text("a") + b"\x88" + text("b") + b"Nu")) == {
        "a": True,
        "b": None,
    }


def test_values() -> None:
    value = {
        "a": [1, -2, 70_000, 1.5, "é", None, True, False],
        "b": (),
        "c": (1,),
        "d": ((1, 2), (3, 4, 5, 6)),
    }
    assert _read(pickle.dumps(value, 2)) == value


@pytest.mark.parametrize(
    "target",
    [
        REBUILD,
        REBUILD_PARAMETER,
        FLOAT_STORAGE,
        ORDERED_DICT,
        LINEAR,
        b"}",
        b"]",
        b")",
        text("a"),
        storage("k", 3),
        tensor(storage("k", 3), (3,), (1,)),
    ],
)
@pytest.mark.parametrize("slots", [False, True])
def test_nothing_but_a_module_has_a_state(target: bytes, slots: bool) -> None:
    attributes = mapping({"__defaults__": group(), "marks": text("a"), "state": b"N"})
    before = [dict(vars(thing)) for thing in (InertModule, Named, *Named, StorageRef, TensorRef, unpickle)]
    state = b"N" + attributes + b"\x86" if slots else attributes
    assert "BUILD at byte" in _fault(target + state + b"b")
    assert before == [
        dict(vars(thing)) for thing in (InertModule, Named, *Named, StorageRef, TensorRef, unpickle)
    ]


def test_a_modules_state_is_one_dictionary_without_slots() -> None:
    state = mapping({"training": b"\x88"})
    assert "not a dictionary" in _fault(LINEAR + b")\x81N" + state + b"\x86b")
    assert "only one" in _fault(LINEAR + b")\x81" + state + b"b" + state + b"b")


@pytest.mark.parametrize(
    "body",
    [
        call(ORDERED_DICT, b"}"),
        call(ORDERED_DICT, b"]"),
        call(FLOAT_STORAGE),
        call(LINEAR),
        call(text("eval"), text("1")),
        call(b"}"),
    ],
)
def test_only_the_builders_are_called(body: bytes) -> None:
    with pytest.raises(UnsafePickleError, match="REDUCE at byte"):
        _read(program(body))


@pytest.mark.parametrize(
    "body",
    [
        call(REBUILD),
        call(REBUILD, storage("k", 3), number(0), group(number(3)), group(number(1)), b"\x89"),
        call(REBUILD, storage("k", 3), b"\x88", group(number(3)), group(number(1)), b"\x89", b"}"),
        call(REBUILD, storage("k", 3), number(0), group(b"N"), group(number(1)), b"\x89", b"}"),
        call(REBUILD, storage("k", 3), number(0), b"]", b"]", b"\x89", b"}"),
        call(REBUILD, storage("k", 3), number(0), b")", b")", b"\x89", mapping({"hook": b"N"})),
        call(REBUILD_PARAMETER, storage("k", 3), b"\x88", b"}"),
        call(REBUILD_PARAMETER, b"N", b"\x88", b"}"),
    ],
)
def test_tensors_are_built_of_what_torch_writes(body: bytes) -> None:
    fault = _fault(body)
    assert "is not a tensor" in fault
    assert "REDUCE at byte" in fault


@pytest.mark.parametrize(
    "key", [b"N", b"\x88", number(1), b")", b"G" + bytes(8), storage("k", 3), LINEAR, text("\x1b")]
)
def test_keys_are_short_printable_strings(key: bytes) -> None:
    assert "SETITEM at byte" in _fault(b"}" + key + b"Ns")
    assert "SETITEMS at byte" in _fault(b"}(" + key + b"Nu")


def test_the_longest_key() -> None:
    assert "not a short" in _fault(b"}" + text("a" * (MAX_NAME_LENGTH + 1)) + b"Ns")
    assert _read(program(b"}" + text("a" * MAX_NAME_LENGTH) + b"Ns"))


@pytest.mark.parametrize(
    ("body", "told"),
    [
        (b"]" + b"(" * MAX_MARKS + b"(", "groups lie within each other (MARK at byte"),
        (b"(" + b"N" * (MAX_TUPLE_ITEMS + 1) + b"t", "items (TUPLE at byte"),
        (b"N\x85\x85\x85", "within a tuple (TUPLE1 at byte 5)"),
        (number(2**64) + b"\x8a\x0b" + bytes(10) + b"\x01", "bits (LONG1 at byte"),
        (b"]N(e", "only a list can be appended to"),
        (b"}NNa", "only a list can be appended to"),
        (b"]NNs", "only a dictionary has items"),
        (b"}(Nu", "a key has no value"),
        (b"}e", "that was not begun"),
        (b"N(\x85t", "an empty stack"),
        (b"N(q\x00t", "an empty stack"),
        (b"h\x07", "nothing is in the memo at 7"),
        (LINEAR + b"]\x81", "arguments are not a tuple"),
        (LINEAR + b"]R", "arguments are not a tuple"),
        (b"NN", "other than one object"),
        (b"N(", "other than one object"),
        (b"\x80\x03N", "of protocol 3"),
    ],
)
def test_other_combinations_are_refused(body: bytes, told: str) -> None:
    assert told in _fault(body)


def test_the_largest_that_is_read() -> None:
    assert _read(program(b"(" + b"N" * MAX_TUPLE_ITEMS + b"t")) == (None,) * MAX_TUPLE_ITEMS
    assert _read(program(b"\x8a\x0b" + b"\xff" * 10 + b"\x00")) == 2**MAX_INT_BITS - 1


_PIECES = [
    *(bytes([code]) for code in b"N\x88\x89])}(\x85\x86\x87teasubR\x81Q"),
    *(b"q" + bytes([index]) for index in range(3)),
    *(b"h" + bytes([index]) for index in range(3)),
    *(text(value) for value in ("_modules", "_parameters", "module", "storage")),
    *(LINEAR, ORDERED_DICT, FLOAT_STORAGE, REBUILD, REBUILD_PARAMETER),
    *(storage("k", 3), tensor(storage("k", 3), (3,), (1,)), module(), number(7)),
]


@given(st.lists(st.sampled_from(_PIECES), max_size=40))
def test_programs_of_known_opcodes_are_refused_or_harmless(pieces: list[bytes]) -> None:
    with contextlib.suppress(ConversionError):
        read = _read(program(b"](" + b"".join(pieces) + b"e"))
        assert type(read) is list
        assert {type(item) for item in read} <= _VALUES


_VALUES = {
    *(type(None), bool, int, str, list, tuple, dict),
    *(InertModule, type(InertModule), Named, StorageRef, TensorRef),
}
