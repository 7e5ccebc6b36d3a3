"""The opcodes of a pickle, which are counted and checked before any of them takes effect."""

import io
import pickletools
from collections.abc import Container, Iterable, Sequence
from typing import Any, NamedTuple

from model.convert.errors import ConversionError, UnsafePickleError

MAX_PICKLE_BYTES = 1 << 24
"""Maximum size of one pickle (the module tree of Trajectron++: 59 kB)."""
MAX_OPCODES = 1 << 17
"""Maximum number of opcodes of one pickle (Trajectron++: 8199), which bounds the size of what it builds."""
MAX_MEMO = MAX_OPCODES
"""Maximum index into a pickle's memo."""

_TOLD_CHARACTERS = 200
"""Maximum number of characters from a file in an error message."""


class Opcode(NamedTuple):
    """One instruction: its name in ``pickletools``, its decoded argument, its position in the file."""

    name: str
    argument: Any
    position: int


def read_opcodes(stream: io.BytesIO) -> Sequence[Opcode]:
    """Read the opcodes of the next pickle of a stream, up to the pickle's end.

    Raises:
        ConversionError: the pickle is incomplete, or larger than ``MAX_PICKLE_BYTES`` or ``MAX_OPCODES``.
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
    except Exception as error:  # pickletools raises many types for damaged pickles
        told = f"{error}"[:_TOLD_CHARACTERS]
        raise ConversionError(
            f"no whole pickle in the {MAX_PICKLE_BYTES} bytes at byte {start}: {told}"
        ) from error
    stream.seek(start + window.tell())
    return opcodes


def check_opcodes(opcodes: Iterable[Opcode], known: Container[str], names: Container[str]) -> None:
    """Refuse a pickle with a foreign name or opcode, even one that would never be reached.

    A foreign name is reported in preference to an earlier foreign opcode, as it says more about the file.

    Args:
        opcodes: all opcodes of the pickle.
        known: names of allowed opcodes.
        names: names that the pickle may use, as "module name".

    Raises:
        UnsafePickleError: the pickle uses any other name or opcode.
        ConversionError: the memo of the pickle is too large.
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
        elif name.startswith("EXT"):  # codes stand for names in the registry of the process
            raise UnsafePickleError(f"the pickle names extension code {argument} ({at(opcode)})")
        elif name.endswith("PUT") and argument > MAX_MEMO:
            raise ConversionError(f"the pickle wants a memo of {argument} entries ({at(opcode)})")
        if foreign is None and name not in known:
            foreign = opcode
    if foreign is not None:
        raise UnsafePickleError(f"the pickle uses an opcode that torch does not write ({at(foreign)})")


def at(opcode: Opcode) -> str:
    """Describe an opcode in an error message."""
    return f"{opcode.name} at byte {opcode.position}"
