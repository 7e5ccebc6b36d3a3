"""An unpickler for torch modules that executes nothing that a pickle names.

A pickle is a program for a stack machine, and Python's own machine can call any function. This one knows only
the opcodes that torch's legacy writer uses, and builds only plain values: scalars, short tuples, lists,
dictionaries with string keys, and stand-ins of modules and tensors. It copies nothing and hashes only short
strings, so that time and memory are linear in the number of opcodes, which is limited.
"""

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final

from model.convert.errors import ConversionError
from model.convert.inert import (
    TORCH_MODULES,
    InertModule,
    Meaning,
    StorageRef,
    TensorRef,
    build,
    is_name,
    refer,
)
from model.convert.opcodes import Opcode, at, check_opcodes, read_opcodes

__all__ = ["TORCH_MODULES", "InertModule", "StorageRef", "TensorRef", "unpickle"]

MAX_MARKS = 256
"""Maximum depth of nested groups (Trajectron++: 10)."""
MAX_TUPLE_ITEMS = 128
MAX_INT_BITS = 80
"""Maximum size of an integer (torch's magic number: 77 bits)."""

_PROTOCOL = 2


def unpickle(stream: io.BytesIO, names: Mapping[str, Meaning]) -> object:
    """Read the next pickle of a stream, up to the pickle's end.

    Args:
        stream: the whole file.
        names: names that the pickle may use, as "module name", and their stand-ins.

    Raises:
        UnsafePickleError: the pickle uses any other name, or an opcode that torch does not write.
        ConversionError: the pickle is incomplete, too large, or of other objects.
    """
    opcodes = read_opcodes(stream)
    check_opcodes(opcodes, _STEPS, names)
    return _Machine(names).run(opcodes)


class _Machine:
    """The stack machine that runs a pickle's opcodes."""

    def __init__(self, names: Mapping[str, Meaning]) -> None:
        self._names = names
        self._stack: list[object] = []
        self._marks: list[int] = []
        self._memo: dict[int, object] = {}

    def run(self, opcodes: Iterable[Opcode]) -> object:
        for opcode in opcodes:
            try:
                _STEPS[opcode.name](self, opcode.argument)
            except ConversionError as error:
                raise type(error)(f"{error} ({at(opcode)})") from None
        return self._stack[0]

    def stop(self, _: object) -> None:
        if len(self._stack) != 1 or self._marks:
            raise ConversionError("the pickle ends with something other than one object")

    def protocol(self, version: int) -> None:
        if version != _PROTOCOL:
            raise ConversionError(f"the pickle is of protocol {version}; torch's files are of {_PROTOCOL}")

    def push(self, value: object) -> None:
        self._stack.append(value)

    def push_int(self, value: int) -> None:
        if value.bit_length() > MAX_INT_BITS:
            raise ConversionError(f"a number has more than {MAX_INT_BITS} bits")
        self.push(value)

    def push_name(self, name: str) -> None:
        self.push(self._names[name])

    def put(self, index: int) -> None:
        self._memo[index] = self._top()

    def get(self, index: int) -> None:
        if index not in self._memo:
            raise ConversionError(f"nothing is in the memo at {index}")
        self.push(self._memo[index])

    def mark(self, _: object) -> None:
        if len(self._marks) == MAX_MARKS:
            raise ConversionError(f"more than {MAX_MARKS} groups lie within each other")
        self._marks.append(len(self._stack))

    def tuple_of(self, count: int) -> None:
        self._push_tuple([self._pop() for _ in range(count)][::-1])

    def tuple_of_group(self, _: object) -> None:
        self._push_tuple(self._pop_group())

    def append(self, _: object) -> None:
        self._extend_list([self._pop()])

    def append_group(self, _: object) -> None:
        self._extend_list(self._pop_group())

    def set_item(self, _: object) -> None:
        value = self._pop()
        self._update_dict([self._pop(), value])

    def set_items_of_group(self, _: object) -> None:
        self._update_dict(self._pop_group())

    def new_object(self, _: object) -> None:
        arguments, cls = self._pop_arguments(), self._pop()
        if cls is not InertModule or arguments:
            raise ConversionError("only modules are made, without arguments")
        self.push(InertModule())

    def set_state(self, _: object) -> None:
        state, module = self._pop(), self._top()
        if type(module) is not InertModule or module.state:
            raise ConversionError("only a module has a state, and only one")
        if type(state) is not dict:
            raise ConversionError("a module's state is not a dictionary")
        module.state = state

    def reduce(self, _: object) -> None:
        arguments, function = self._pop_arguments(), self._pop()
        self.push(build(function, arguments))

    def refer(self, _: object) -> None:
        self.push(refer(self._pop()))

    def _top(self) -> object:
        if len(self._stack) == (self._marks[-1] if self._marks else 0):
            raise ConversionError("the pickle takes from an empty stack")
        return self._stack[-1]

    def _pop(self) -> object:
        top = self._top()
        del self._stack[-1]
        return top

    def _pop_arguments(self) -> tuple[object, ...]:
        arguments = self._pop()
        if type(arguments) is not tuple:
            raise ConversionError("arguments are not a tuple")
        return arguments

    def _pop_group(self) -> list[object]:
        if not self._marks:
            raise ConversionError("a group ends that was not begun")
        start = self._marks.pop()
        group = self._stack[start:]
        del self._stack[start:]
        return group

    def _push_tuple(self, items: Sequence[object]) -> None:
        if len(items) > MAX_TUPLE_ITEMS:
            raise ConversionError(f"a tuple has more than {MAX_TUPLE_ITEMS} items")
        if any(type(part) is tuple for item in items if type(item) is tuple for part in item):
            raise ConversionError("a tuple of tuples lies within a tuple")
        self.push(tuple(items))

    def _extend_list(self, items: Iterable[object]) -> None:
        target = self._top()
        if type(target) is not list:
            raise ConversionError("only a list can be appended to")
        target.extend(items)

    def _update_dict(self, items: Sequence[object]) -> None:
        target = self._top()
        if type(target) is not dict:
            raise ConversionError("only a dictionary has items to set")
        if len(items) % 2:
            raise ConversionError("a key has no value")
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not is_name(key):
                raise ConversionError("a key of a dictionary is not a short printable string")
            target[key] = value


_Step = Callable[[_Machine, Any], None]

_STEPS: Final[Mapping[str, _Step]] = {
    "PROTO": _Machine.protocol,
    "STOP": _Machine.stop,
    "NONE": lambda machine, _: machine.push(None),
    "NEWTRUE": lambda machine, _: machine.push(True),
    "NEWFALSE": lambda machine, _: machine.push(False),
    "BININT": _Machine.push_int,
    "BININT1": _Machine.push_int,
    "BININT2": _Machine.push_int,
    "LONG1": _Machine.push_int,
    "LONG4": _Machine.push_int,
    "BINFLOAT": _Machine.push,
    "BINUNICODE": _Machine.push,
    "GLOBAL": _Machine.push_name,
    "BINPUT": _Machine.put,
    "LONG_BINPUT": _Machine.put,
    "BINGET": _Machine.get,
    "LONG_BINGET": _Machine.get,
    "MARK": _Machine.mark,
    "EMPTY_TUPLE": lambda machine, _: machine.tuple_of(0),
    "TUPLE1": lambda machine, _: machine.tuple_of(1),
    "TUPLE2": lambda machine, _: machine.tuple_of(2),
    "TUPLE3": lambda machine, _: machine.tuple_of(3),
    "TUPLE": _Machine.tuple_of_group,
    "EMPTY_LIST": lambda machine, _: machine.push([]),
    "APPEND": _Machine.append,
    "APPENDS": _Machine.append_group,
    "EMPTY_DICT": lambda machine, _: machine.push({}),
    "SETITEM": _Machine.set_item,
    "SETITEMS": _Machine.set_items_of_group,
    "NEWOBJ": _Machine.new_object,
    "BUILD": _Machine.set_state,
    "REDUCE": _Machine.reduce,
    "BINPERSID": _Machine.refer,
}
"""The allowed opcodes, and the methods that run them."""
