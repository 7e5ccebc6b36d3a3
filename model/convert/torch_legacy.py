"""The file format of torch before version 1.6, read into numpy arrays.

A file consists of five pickles (magic number, format version, facts about the writing machine, the object,
the keys of its storages), then each storage: its length as int64, and its raw little-endian numbers
(``torch/serialization.py``, ``_legacy_save``).
"""

import io
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from model.arrays import Float32s
from model.convert.errors import ConversionError
from model.convert.inert import TORCH_MODULES, InertModule, TensorRef, is_name
from model.convert.unpickling import unpickle

MAX_FILE_BYTES = 1 << 29
"""Maximum size of a file (Trajectron++: 1.3 MB)."""
MAX_DEPTH = 16
"""Maximum depth of nested modules."""
MAX_MODULES = 10_000
"""Maximum number of modules in a tree (Trajectron++: 51)."""
MAX_PARAMETERS = 10_000
"""Maximum number of parameters in a tree, including None (Trajectron++: 110)."""

_MAGIC = 0x1950A86A20F9469CFC6C
_FORMAT_VERSION = 1001
_ZIP_MAGIC = b"PK\x03\x04"


def read_parameters(file: Path) -> dict[str, Float32s]:
    """Read the parameters of a pickled module tree.

    Args:
        file: a file in torch's legacy format that holds one nn.Module.

    Returns:
        Arrays by the names that ``state_dict`` would give them.

    Raises:
        UnsafePickleError: the file names or does anything not known to be harmless; nothing was executed.
        ConversionError: the file is damaged or of another format.
    """
    try:
        return _parameters(_load(file))
    except ConversionError as error:
        raise type(error)(f"{file}: {error}") from error
    except OSError as error:
        raise ConversionError(f"{file}: cannot be read: {error.strerror}") from error


def _load(file: Path) -> io.BytesIO:
    size = file.stat().st_size
    if size > MAX_FILE_BYTES:
        raise ConversionError(f"{size} bytes are too many; at most {MAX_FILE_BYTES} are read")
    with file.open("rb") as handle:
        data = handle.read(size)  # and no more, even if the file has grown
    if data.startswith(_ZIP_MAGIC):
        raise ConversionError(
            "this is a zip archive, the format of torch since 1.6; only legacy files are read "
            "(torch.save(..., _use_new_zipfile_serialization=False) writes them)"
        )
    return io.BytesIO(data)


def _parameters(stream: io.BytesIO) -> dict[str, Float32s]:
    if unpickle(stream, {}) != _MAGIC:
        raise ConversionError("this is not a file of torch: the magic number is missing")
    if unpickle(stream, {}) != _FORMAT_VERSION:
        raise ConversionError("this file is not of torch's legacy format version 1001")
    system = unpickle(stream, {})
    if not isinstance(system, dict) or system.get("little_endian") is not True:
        raise ConversionError("the file was not written by a little-endian machine")
    root = unpickle(stream, TORCH_MODULES)
    references = dict(_walk(root))
    storages = _storages(stream)
    budget = sum(map(len, storages.values()))
    parameters = {}
    for name, reference in references.items():
        array = _tensor(name, reference, storages)
        budget -= array.size
        if budget < 0:  # or a small file could demand unlimited memory
            raise ConversionError("the parameters overlap in their storages")
        parameters[name] = array.copy()
    return parameters


def _storages(stream: io.BytesIO) -> Mapping[str, Float32s]:
    """Read the storages that follow the object, by key."""
    keys = unpickle(stream, {})
    if not isinstance(keys, list) or not all(map(is_name, keys)):
        raise ConversionError("the list of storages is damaged")
    rest = stream.getbuffer()[stream.tell() :]
    storages: dict[str, Float32s] = {}
    for key in keys:
        if key in storages:
            raise ConversionError(f"storage {key} is listed twice")
        count = int.from_bytes(rest[:8], "little", signed=True)
        if len(rest) < 8 or not 0 <= 4 * count <= len(rest) - 8:
            raise ConversionError(f"storage {key} wants {count} numbers, but the file ends before")
        storages[key] = np.frombuffer(rest[8 : 8 + 4 * count], dtype="<f4")
        rest = rest[8 + 4 * count :]
    if len(rest):
        raise ConversionError("the storages do not add up to the file")
    return storages


def _walk(root: object) -> Iterator[tuple[str, object]]:
    """Yield names and tensor references of all parameters of a module tree, in its order."""
    pending: list[tuple[tuple[str, ...], object]] = [((), root)]
    modules: set[InertModule] = set()
    parameters = 0
    while pending:
        path, module = pending.pop()
        if not isinstance(module, InertModule):
            raise ConversionError(f"{_told(path)} is not a module")
        if module in modules:  # or a small file could name it any number of times
            raise ConversionError(f"the tree of modules is too large, or none: {_told(path)} is in it twice")
        modules.add(module)
        if len(path) > MAX_DEPTH:
            raise ConversionError(f"the tree of modules is too large: more than {MAX_DEPTH} deep")
        if _part(module, path, "_buffers", MAX_PARAMETERS):
            raise ConversionError(f"{_told(path)} has buffers, which no network here has")
        own = _part(module, path, "_parameters", MAX_PARAMETERS - parameters)
        parameters += len(own)
        for name, parameter in own.items():
            if parameter is not None:
                yield ".".join((*path, name)), parameter
        children = _part(module, path, "_modules", MAX_MODULES - len(modules) - len(pending))
        pending.extend(((*path, name), child) for name, child in children.items())


def _part(module: InertModule, path: tuple[str, ...], name: str, limit: int) -> dict[str, object]:
    part = module.state.get(name, {})
    if not isinstance(part, dict):
        raise ConversionError(f"{name} of {_told(path)} is damaged")
    if len(part) > limit:
        raise ConversionError(f"the tree of modules is too large: {len(part)} {name} in {_told(path)}")
    if not all(key and "." not in key for key in part):
        raise ConversionError(f"{name} of {_told(path)} is damaged: a name is empty, or has a dot in it")
    return part


def _told(path: tuple[str, ...]) -> str:
    return ".".join(path) or "the object"


def _tensor(name: str, reference: object, storages: Mapping[str, Float32s]) -> Float32s:
    """Return a read-only view of a storage; numpy checks that shape and strides stay within it."""
    if not isinstance(reference, TensorRef):
        raise ConversionError(f"{name} is not a tensor")
    (key, count), offset, size, stride = reference
    storage = storages.get(key)
    if storage is None or len(storage) != count:
        raise ConversionError(f"the storage of {name} is missing, or not of {count} numbers")
    if len(size) != len(stride) or not all(0 <= number <= count for number in (offset, *size, *stride)):
        raise ConversionError(f"the shape of {name} is out of bounds")
    try:
        return np.ndarray(
            size, dtype="<f4", buffer=storage, offset=4 * offset, strides=tuple(4 * step for step in stride)
        )
    except (ValueError, TypeError) as error:
        raise ConversionError(f"{name} reaches beyond its storage: {error}") from error
