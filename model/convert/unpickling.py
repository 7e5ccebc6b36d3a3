"""Pickles of torch modules, read without running anything that they name.

A pickle is a program: it may name any function and call it. Here every name is looked up in a short list,
and stands for something inert; any other name ends the reading before the pickle can use it.
"""

import io
import pickle
import pickletools
from collections.abc import Mapping
from typing import NamedTuple, NoReturn, Self

from model.convert.errors import ConversionError, UnsafePickleError

MAX_MEMO = 1 << 20
"""Largest index into the pickle's memo; Python sets memory aside for all smaller ones."""
_EXTENSIONS = frozenset({"EXT1", "EXT2", "EXT4"})


class StorageRef(NamedTuple):
    """Where a tensor's numbers lie: in the storage of that key, which follows the pickle."""

    key: object
    length: object


class TensorRef(NamedTuple):
    """A tensor as the pickle describes it; of its fields nothing is known to be true."""

    storage: object
    offset: object
    size: object
    stride: object


class InertModule:
    """Stands for any ``nn.Module``: keeps its state, does nothing."""

    __slots__ = ("state",)

    state: Mapping[object, object]

    def __new__(cls) -> Self:
        """Not ``__init__``: unpickling does without that."""
        self = super().__new__(cls)
        self.state = {}
        return self

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, dict):
            raise ConversionError("a module's state is not a dictionary")
        self.state = state


class FloatStorage:
    """Stands for ``torch.FloatStorage``: only its name counts."""


def _rebuild_tensor(
    storage: object, offset: object, size: object, stride: object, _requires_grad: object, _hooks: object
) -> TensorRef:
    return TensorRef(storage, offset, size, stride)


def _rebuild_parameter(data: object, _requires_grad: object, _hooks: object) -> object:
    return data


_MODULE_CLASSES = (
    "model.components.additive_attention AdditiveAttention",
    "model.components.map_encoder CNNMapEncoder",
    "torch.nn.modules.container ModuleDict",
    "torch.nn.modules.container ModuleList",
    "torch.nn.modules.container Sequential",
    "torch.nn.modules.conv Conv2d",
    "torch.nn.modules.linear Linear",
    "torch.nn.modules.rnn GRUCell",
    "torch.nn.modules.rnn LSTM",
)
TORCH_MODULES: Mapping[str, object] = {
    "collections OrderedDict": dict,
    "torch FloatStorage": FloatStorage,
    "torch._utils _rebuild_parameter": _rebuild_parameter,
    "torch._utils _rebuild_tensor_v2": _rebuild_tensor,
    **dict.fromkeys(_MODULE_CLASSES, InertModule),
}
"""What a Trajectron++ checkpoint names, and what each name stands for here."""


def unpickle(stream: io.BytesIO, names: Mapping[str, object]) -> object:
    """The next pickle of a stream, which is left at the pickle's end.

    Args:
        stream: the whole file.
        names: what the pickle may name, as "module name", and what each stands for.

    Raises:
        UnsafePickleError: it names anything else.
        ConversionError: it is no whole pickle, or not of such objects.
    """
    start = stream.tell()
    _scan(stream)
    end = stream.tell()
    program = stream.getbuffer()[start:end]
    try:
        return _Unpickler(io.BytesIO(program), names).load()
    except ConversionError:
        raise
    except Exception as error:  # a damaged pickle can raise nearly anything
        raise ConversionError(f"the pickle at byte {start} is damaged: {error}") from error


def _scan(stream: io.BytesIO) -> None:
    """Reads over a pickle without running it, and refuses what the unpickler itself would not look at."""
    start = stream.tell()
    try:
        for opcode, argument, position in pickletools.genops(stream):
            if opcode.name in _EXTENSIONS:
                # Code numbers stand for names of the process's own registry, and may skip find_class
                raise UnsafePickleError(f"the pickle names extension code {argument} (at byte {position})")
            if opcode.name.endswith("PUT") and int(argument or 0) > MAX_MEMO:
                raise ConversionError(f"the pickle at byte {start} wants a memo of {argument} entries")
    except ConversionError:
        raise
    except Exception as error:  # likewise
        raise ConversionError(f"no whole pickle at byte {start}: {error}") from error


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: io.BytesIO, names: Mapping[str, object]) -> None:
        super().__init__(stream)
        self._names = names

    def find_class(self, module: str, name: str, /) -> object:
        """The inert stand-in of a name; called for every name in a pickle, however it is spelled."""
        try:
            return self._names[f"{module} {name}"]
        except KeyError:
            raise UnsafePickleError(f"the pickle names {module}.{name}, which is not allowed") from None

    def persistent_load(self, pid: object, /) -> object:
        """Torch's two kinds of outside objects: classes with their source code, and storages."""
        match pid:
            case ("module", type() as module, str(), str()):
                return module
            case ("storage", storage, str() as key, str(), int() as length, None) if storage is FloatStorage:
                return StorageRef(key, length)
        _refuse_reference()


def _refuse_reference() -> NoReturn:
    raise ConversionError("the pickle refers to something that is neither a class nor a float32 storage")
