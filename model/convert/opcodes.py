"""The opcodes of a pickle: read, counted and looked through before any of them takes effect."""

import io
import pickletools
from collections.abc import Container, Iterable, Sequence
from typing import Any, NamedTuple

from model.convert.errors import ConversionError, UnsafePickleError

MAX_PICKLE_BYTES = 1 << 24
"""Of one pickle (the module tree of Trajectron++ takes 59 kB)."""
MAX_OPCODES = 1 << 17
"""Of one pickle (Trajectron++: 8199). Nothing that a pickle builds is larger than what its opcodes name."""
MAX_MEMO = MAX_OPCODES
"""Largest index into a pickle's memo."""

_TOLD_CHARACTERS = 200
"""Of what a file says about itself in an error's message."""


class Opcode(NamedTuple):
    """One instruction: its name in ``pickletools``, its decoded argument, its byte in the file."""

    name: str
    argument: Any
    position: int


def read_opcodes(stream: io.BytesIO) -> Sequence[Opcode]:
    """The next pickle of a stream, which is left at the pickle's end.

    Raises:
        ConversionError: it is no whole pickle, or larger than ``MAX_PICKLE_BYTES`` or ``MAX_OPCODES``.
    """
    start = stream.tell()
    window = io.BytesIO(stream.getbuffer()[start : start + MAX_PICKLE_BYTES])
    opcodes: list[Opcode] = []
    try:
        for opcode, argument, position in pickletools.genops(window):
            if len(opcodes) == MAX_OPCODES:
                raise ConversionError(f"the pickle at byte {start} has more than {MAX_OPCODES} opcodes")
            opcodes.append(Opcode(opcode.name, argument, start + (position or 0)))
    except ConversionError:
        raise
    except Exception as error:  # a damaged pickle can raise nearly anything
        told = f"{error}"[:_TOLD_CHARACTERS]
        raise ConversionError(
            f"no whole pickle in the {MAX_PICKLE_BYTES} bytes at byte {start}: {told}"
        ) from error
    stream.seek(start + window.tell())
    return opcodes


def check_opcodes(opcodes: Iterable[Opcode], known: Container[str], names: Container[str]) -> None:
    """Refuses a pickle for what it says, whether or not it would ever come to that.

    A foreign name is told rather than a foreign opcode before it, as it says more about the file.

    Args:
        opcodes: the whole pickle.
        known: the opcodes that it may use.
        names: what it may name, as "module name".

    Raises:
        UnsafePickleError: it names anything else, or uses any other opcode.
        ConversionError: its memo is too large.
    """
    foreign: Opcode | None = None
    texts = ["", ""]
    for opcode in opcodes:
        name, argument, _ = opcode
        if name.endswith("UNICODE") or name == "BINUNICODE8":
            texts = [texts[1], argument]
        elif name in {"GLOBAL", "INST", "STACK_GLOBAL"}:
            named = " ".join(texts) if name == "STACK_GLOBAL" else argument
            if named not in names:
                told = ascii(named[:_TOLD_CHARACTERS])[1:-1].replace(" ", ".")
                raise UnsafePickleError(f"the pickle names {told}, which is not allowed ({at(opcode)})")
        elif name.startswith("EXT"):  # code numbers stand for names of the process's own registry
            raise UnsafePickleError(f"the pickle names extension code {argument} ({at(opcode)})")
        elif name.endswith("PUT") and argument > MAX_MEMO:
            raise ConversionError(f"the pickle wants a memo of {argument} entries ({at(opcode)})")
        if foreign is None and name not in known:
            foreign = opcode
    if foreign is not None:
        raise UnsafePickleError(f"the pickle uses an opcode that torch does not write ({at(foreign)})")


def at(opcode: Opcode) -> str:
    """Which opcode it is, for an error's message."""
    return f"{opcode.name} at byte {opcode.position}"
