"""Small files that would take much time, much memory or the whole process, were they read without limits.

As a program, reads the files of a folder, and prints a line of JSON on each.
"""

import json
import resource
import struct
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

from tests.model.convert.assembler import legacy_file, mapping, module, named, number, storage, tensor, text

LINKS = 15_000
"""Length of a chain; C code that calls itself for each would end the process."""


class Hostile(NamedTuple):
    """A file's module tree, and what the error has to say."""

    body: bytes
    told: str


class Outcome(NamedTuple):
    """Outcome of reading a file: the error's class and message, the time, and the additional memory."""

    name: str
    error: str
    message: str
    seconds: float
    megabytes: float


def put(index: int) -> bytes:
    return b"r" + struct.pack("<I", index)


def get(index: int) -> bytes:
    return b"j" + struct.pack("<I", index)


def listed(items: Iterable[bytes]) -> bytes:
    return b"](" + b"".join(items) + b"e"


def _tuples_of_tuples(levels: int) -> bytes:
    """Each holds the one before twice, by the memo; the hash of the last would look at 2**levels."""
    tuples = b"".join(get(n) + get(n) + b"\x86" + put(n + 1) for n in range(levels))
    return b")" + put(0) + tuples + b"}" + get(levels) + b"Ns"


def _copies() -> bytes:
    """A large dictionary, copied by the call of its class."""
    copy = named("collections", "OrderedDict") + get(0) + b"\x85R"
    return listed([mapping({f"k{n}": b"N" for n in range(20_000)}) + put(0), copy * 20_000])


def _chain(link: bytes, attach: bytes) -> bytes:
    """Objects each of which holds the next, and nothing else does."""
    return b"]" + link * LINKS + b"N" + attach * LINKS + b"a"


def _shared(count: int, share_module: bool) -> bytes:
    """A thousand names of one module, or of one dictionary of parameters, that many."""
    parameters = {
        f"p{n}": get(0) if n else tensor(storage("k", 4), (1,), (1,)) + put(0) for n in range(count)
    }
    kind = named("torch.nn.modules.linear", "Linear") + b")\x81"
    own = kind + mapping({"_parameters": mapping(parameters) + put(1)}) + b"b" + put(2)
    other = get(2) if share_module else kind + mapping({"_parameters": get(1)}) + b"b"
    return module(modules={f"m{n}": other if n else own for n in range(1_000)})


def _equal_keys() -> bytes:
    """Two long strings that are equal, each found to be so at every look-up."""
    long = text("k" * 4_000_000)
    return (
        listed([long + put(0), long + put(1)])
        + put(2)
        + b"}("
        + (get(0) + b"N" + get(1) + b"N") * 20_000
        + b"u"
    )


def _colliding_keys() -> bytes:
    """Numbers that all have the same hash."""
    return b"}(" + b"".join(number(n * sys.hash_info.modulus) + b"N" for n in range(1, 400)) * 100 + b"u"


DEEP_TUPLE = "a tuple of tuples lies within a tuple"

HOSTILE: Mapping[str, Hostile] = {
    "a tuple a million deep as a key": Hostile(
        b"})" + b"\x85" * 1_000_000 + b"Ns", "more than 131072 opcodes"
    ),
    "a tuple a bit less deep": Hostile(b"})" + b"\x85" * 100_000 + b"Ns", DEEP_TUPLE),
    "tuples doubled on the stack": Hostile(b"})" + b"2\x86" * 60 + b"Ns", "DUP at byte"),
    "tuples doubled by the memo": Hostile(_tuples_of_tuples(60), DEEP_TUPLE),
    "copies of a dictionary": Hostile(_copies(), "REDUCE at byte"),
    "a module shared": Hostile(_shared(9_000, share_module=True), "is in it twice"),
    "a larger module shared": Hostile(_shared(20_000, share_module=True), "too large: 20000 _parameters"),
    "parameters shared": Hostile(_shared(9_000, share_module=False), "too large: 9000 _parameters"),
    "long keys that are equal": Hostile(_equal_keys(), "not a short printable string"),
    "keys that collide": Hostile(_colliding_keys(), "not a short printable string"),
    "a chain of lists": Hostile(_chain(b"]", b"a"), "not a module"),
    "a chain of dictionaries": Hostile(_chain(b"}" + text("k"), b"s"), "not a module"),
    "a chain of modules": Hostile(
        _chain(named("torch.nn.modules.linear", "Linear") + b")\x81}" + text("k"), b"sb"), "not a module"
    ),
    "a chain of tuples and lists": Hostile(_chain(b"]", b"\x85a"), "not a module"),
    "a name without end": Hostile(named("a" * 1_000_000, "b"), "names aaa"),
    "groups within groups": Hostile(b"(" * 100_000, "more than 256 groups"),
}
"""Hostile files by their kind; each is a file of at most some megabytes."""


def _outcomes(folder: Path) -> Iterator[Outcome]:
    from model.convert.errors import ConversionError
    from model.convert.torch_legacy import read_parameters

    for file in sorted(folder.iterdir()):
        size = _peak_megabytes()
        start = time.perf_counter()
        error: Exception | None = None
        try:
            read_parameters(file)
        except ConversionError as caught:
            error = caught
        seconds = time.perf_counter() - start
        yield Outcome(file.name, type(error).__name__, str(error), seconds, _peak_megabytes() - size)


def _peak_megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def write(folder: Path) -> None:
    """All files, by name."""
    for name, hostile in HOSTILE.items():
        (folder / name).write_bytes(legacy_file(hostile.body))


if __name__ == "__main__":
    for outcome in _outcomes(Path(sys.argv[1])):
        sys.stdout.write(json.dumps(outcome) + "\n")
        sys.stdout.flush()
