import io
from pathlib import Path

import pytest

from model.convert import opcodes
from model.convert.errors import ConversionError, UnsafePickleError
from model.convert.opcodes import MAX_OPCODES, check_opcodes, read_opcodes
from model.convert.unpickling import _STEPS, TORCH_MODULES, unpickle
from tests.model.convert.assembler import named, program, text


def _check(body: bytes, known: set[str]) -> None:
    check_opcodes(read_opcodes(io.BytesIO(program(body))), {"PROTO", "STOP", *known}, {"a B"})


def test_opcodes_have_their_place_in_the_file() -> None:
    stream = io.BytesIO(b"ab" + program(b"N" + text("é")) + b"rest")
    stream.seek(2)
    assert list(read_opcodes(stream)) == [
        ("PROTO", 2, 2),
        ("NONE", None, 4),
        ("BINUNICODE", "é", 5),
        ("STOP", None, 12),
    ]
    assert stream.read() == b"rest"


def test_the_number_of_opcodes_is_limited() -> None:
    largest = b"](" + b"N" * (MAX_OPCODES - 5) + b"e"
    assert len(read_opcodes(io.BytesIO(program(largest)))) == MAX_OPCODES
    with pytest.raises(ConversionError, match="byte 0 has more than 131072 opcodes"):
        read_opcodes(io.BytesIO(program(b"N" + largest)))


def test_the_size_of_a_pickle_is_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    data = program(text("a" * 100))
    monkeypatch.setattr(opcodes, "MAX_PICKLE_BYTES", len(data))
    assert len(read_opcodes(io.BytesIO(data + b"rest"))) == 3
    monkeypatch.setattr(opcodes, "MAX_PICKLE_BYTES", len(data) - 1)
    with pytest.raises(ConversionError, match="no whole pickle in the 107 bytes at byte 0"):
        read_opcodes(io.BytesIO(data + b"rest"))


def test_messages_are_short() -> None:
    with pytest.raises(ConversionError) as caught:
        read_opcodes(io.BytesIO(b"S" + b"a" * 100_000 + b"\\n."))
    assert len(str(caught.value)) < 300


def test_other_opcodes_are_told_with_their_place() -> None:
    _check(b"N", {"NONE"})
    with pytest.raises(UnsafePickleError, match=r"does not write \(DUP at byte 3\)"):
        _check(b"N20", {"NONE"})


def test_a_foreign_name_is_told_rather_than_an_opcode_before_it() -> None:
    _check(named("a", "B"), {"GLOBAL"})
    with pytest.raises(
        UnsafePickleError, match=r"names os\.system, which is not allowed \(GLOBAL at byte 4\)"
    ):
        _check(b"N2" + named("os", "system"), set())


def test_names_cannot_write_to_the_terminal() -> None:
    with pytest.raises(UnsafePickleError, match=r"names \\x1b\[2J\.b, which"):
        _check(named("\x1b[2J", "b"), {"GLOBAL"})


def test_the_published_file_uses_most_of_what_is_known(shared: Path) -> None:
    data = (shared / "reference/weights/trajectron_int_ee_me/model_registrar-12.pt").read_bytes()
    stream = io.BytesIO(data)
    used = {opcode.name for _ in range(5) for opcode in read_opcodes(stream)}
    stream.seek(0)
    for names in ({}, {}, {}, TORCH_MODULES, {}):
        unpickle(stream, names)
    assert _STEPS.keys() - used == {"BININT", "LONG4"}, "large and negative numbers"
