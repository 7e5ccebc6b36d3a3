"""Inert stand-ins for torch's objects in a pickle: plain values without behaviour."""

from collections.abc import Mapping
from enum import Enum, auto
from typing import NamedTuple, TypeAlias, TypeGuard

from model.convert.errors import ConversionError, UnsafePickleError

MAX_NAME_LENGTH = 128
"""Maximum number of characters of an attribute, module, parameter or storage key."""


class StorageRef(NamedTuple):
    """A reference to the storage of a tensor's numbers, which follows the pickle."""

    key: str
    length: int


class TensorRef(NamedTuple):
    """A tensor as the pickle describes it; its storage is not yet known to exist and to be large enough."""

    storage: StorageRef
    offset: int
    size: tuple[int, ...]
    stride: tuple[int, ...]


class InertModule:
    """A stand-in for any ``nn.Module``, which only holds its state."""

    __slots__ = ("state",)

    def __init__(self) -> None:
        self.state: Mapping[str, object] = {}


class Named(Enum):
    """The names in a checkpoint besides its modules; members can be neither called nor changed."""

    ORDERED_DICT = auto()
    FLOAT_STORAGE = auto()
    REBUILD_TENSOR = auto()
    REBUILD_PARAMETER = auto()


Meaning: TypeAlias = type[InertModule] | Named

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
TORCH_MODULES: Mapping[str, Meaning] = {
    "collections OrderedDict": Named.ORDERED_DICT,
    "torch FloatStorage": Named.FLOAT_STORAGE,
    "torch._utils _rebuild_parameter": Named.REBUILD_PARAMETER,
    "torch._utils _rebuild_tensor_v2": Named.REBUILD_TENSOR,
    **dict.fromkeys(_MODULE_CLASSES, InertModule),
}
"""The names in a Trajectron++ checkpoint, and their stand-ins."""


def is_name(value: object) -> TypeGuard[str]:
    """Return whether this is a string that may be a key and appear in a message: short and printable."""
    return type(value) is str and len(value) <= MAX_NAME_LENGTH and value.isprintable()


def build(function: object, arguments: tuple[object, ...]) -> dict[str, object] | TensorRef:
    """Return the result of one of torch's builders: an empty dictionary, or a tensor.

    Raises:
        UnsafePickleError: the function is none of these builders.
        ConversionError: the arguments are none that torch writes.
    """
    if function is Named.ORDERED_DICT and not arguments:
        return {}
    if function is Named.REBUILD_TENSOR:
        return _tensor(arguments)
    if function is Named.REBUILD_PARAMETER:
        return _parameter(arguments)
    raise UnsafePickleError("the pickle calls something other than the builders of tensors and OrderedDict()")


def _tensor(arguments: tuple[object, ...]) -> TensorRef:
    match arguments:
        case (StorageRef() as storage, offset, tuple() as size, tuple() as stride, bool(), dict() as hooks):
            numbers = (offset, *size, *stride)
            if not hooks and all(type(number) is int for number in numbers):
                return TensorRef(storage, numbers[0], size, stride)
    raise ConversionError("what _rebuild_tensor_v2 is called with is not a tensor")


def _parameter(arguments: tuple[object, ...]) -> TensorRef:
    match arguments:
        case (TensorRef() as tensor, bool(), dict() as hooks) if not hooks:
            return tensor
    raise ConversionError("what _rebuild_parameter is called with is not a tensor")


def refer(pid: object) -> type[InertModule] | StorageRef:
    """Resolve a persistent id: a class with its source code, or a storage.

    Raises:
        ConversionError: the id is neither.
    """
    match pid:
        case ("module", cls, str(), str()) if cls is InertModule:
            return InertModule
        case ("storage", Named.FLOAT_STORAGE, key, str(), length, None):
            if is_name(key) and type(length) is int:
                return StorageRef(key, length)
    raise ConversionError("the pickle refers to something that is neither a class nor a float32 storage")
