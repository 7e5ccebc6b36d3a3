"""The reference of the contract (docs/contract.md), generated from the .proto files and their comments."""

import itertools
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
    FileDescriptorSet,
)
from grpc_tools import protoc

from cab.forecast.v1.routes import ROUTES
from docs.tables import table
from service.access.scopes import scope_of

PROTO = Path(__file__).resolve().parents[1] / "proto"
_ORDER = ("prediction", "explanation", "model", "consistency", "scene", "admin")
"""Services in the order of the page; files without a service come last."""
_MESSAGE, _ENUM, _SERVICE = (
    FileDescriptorProto.MESSAGE_TYPE_FIELD_NUMBER,
    FileDescriptorProto.ENUM_TYPE_FIELD_NUMBER,
    FileDescriptorProto.SERVICE_FIELD_NUMBER,
)
_FIELD, _VALUE, _METHOD = 2, 2, 2
"""Numbers of the lists of fields, values and methods in the descriptors."""

Comments = dict[tuple[int, ...], str]
"""Comments of a file by the path of what they stand before."""


def methods_table() -> str:
    """Return a row for each method: gRPC and REST names, messages, and the scope that a key needs."""
    return table(
        ["Method", "REST", "Request", "Response", "Scope of the key"],
        [
            [
                f"[{route.service.rpartition('.')[2]}](#{route.service.rpartition('.')[2].lower()}).{route.method}",
                f"`{route.verb} {route.path}`",
                _link(route.request.DESCRIPTOR.name),
                ("stream of " if route.streaming else "") + _link(route.response.DESCRIPTOR.name),
                "none" if (scope := scope_of(route)) is None else f"`{scope}`",
            ]
            for route in ROUTES
        ],
    )


def contract() -> str:
    """Return services, messages and enums of all .proto files with their comments."""
    files = sorted(_descriptors(), key=lambda file: _rank(file.name))
    return "\n\n".join(part for file in files for part in _file(file))


def _descriptors() -> Sequence[FileDescriptorProto]:
    """Return the descriptors of the .proto files, with comments.

    Raises:
        ValueError: protoc refuses a file.
    """
    names = [str(file.relative_to(PROTO)) for file in sorted(PROTO.rglob("*.proto"))]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "contract.binpb")
        options = [f"-I{PROTO}", "--include_source_info", f"--descriptor_set_out={out}"]
        if protoc.main(["protoc", *options, *names]) != 0:
            raise ValueError("protoc refuses a .proto file; its message is above")
        return FileDescriptorSet.FromString(out.read_bytes()).file


def _rank(name: str) -> int:
    return next((rank for rank, start in enumerate(_ORDER) if Path(name).stem.startswith(start)), len(_ORDER))


def _file(file: FileDescriptorProto) -> Iterator[str]:
    comments: Comments = {
        tuple(location.path): location.leading_comments
        for location in file.source_code_info.location
        if location.leading_comments
    }
    for number, service in enumerate(file.service):
        path = (_SERVICE, number)
        yield f"## {service.name}"
        yield _prose(comments.get(path, ""))
        for index, method in enumerate(service.method):
            yield f"**{method.name}**: {_prose(comments.get((*path, _METHOD, index), ''))}"
    if not file.service:
        yield f"## {Path(file.name).stem.capitalize()}"
    for number, message in enumerate(file.message_type):
        yield from _message(message, comments, (_MESSAGE, number))
    for number, enum in enumerate(file.enum_type):
        yield from _enum(enum, comments, (_ENUM, number))


def _message(message: DescriptorProto, comments: Comments, path: tuple[int, ...]) -> Iterator[str]:
    yield f"### {message.name}"
    if path in comments:
        yield _prose(comments[path])
    if not message.field:
        yield "It has no fields."
        return
    yield table(
        ["Field", "No.", "Type", "Meaning"],
        [
            [
                f"`{field.name}`",
                str(field.number),
                _type(field, message),
                _cell(comments.get((*path, _FIELD, index), "")),
            ]
            for index, field in enumerate(message.field)
        ],
    )


def _enum(enum: EnumDescriptorProto, comments: Comments, path: tuple[int, ...]) -> Iterator[str]:
    yield f"### {enum.name}"
    if path in comments:
        yield _prose(comments[path])
    yield table(
        ["Value", "No.", "Meaning"],
        [
            [f"`{value.name}`", str(value.number), _cell(comments.get((*path, _VALUE, index), ""))]
            for index, value in enumerate(enum.value)
        ],
    )


def _type(field: FieldDescriptorProto, message: DescriptorProto) -> str:
    """Return a field's type, with a link to that of a message or an enum."""
    name = field.type_name.rpartition(".")[2]
    for entry in message.nested_type:
        if entry.name == name and entry.options.map_entry:
            return f"map of {_type(entry.field[0], entry)} to {_type(entry.field[1], entry)}"
    if field.type_name:
        kind = _link(name)
    else:
        kind = f"`{FieldDescriptorProto.Type.Name(field.type).removeprefix('TYPE_').lower()}`"
    if field.label == FieldDescriptorProto.LABEL_REPEATED:
        return f"repeated {kind}"
    if field.proto3_optional:
        return f"optional {kind}"
    if field.HasField("oneof_index"):
        return f"{kind}, one of `{message.oneof_decl[field.oneof_index].name}`"
    return kind


def _link(name: str) -> str:
    return f"[{name}](#{name.lower()})"


def _lines(comment: str) -> list[str]:
    return [line.removeprefix(" ") for line in comment.rstrip().split("\n")]


def _prose(comment: str) -> str:
    """Return a comment as Markdown; indented lines become a code block."""
    parts = []
    for indented, lines in itertools.groupby(_lines(comment), key=lambda line: line.startswith(" ")):
        text = "\n".join(lines)
        parts.append(f"```text\n{text}\n```" if indented else _escaped(text.strip("\n")))
    return "\n\n".join(parts)


def _cell(comment: str) -> str:
    """Return a comment as a cell of a table, with line breaks between its paragraphs."""
    paragraphs = "\n".join(_lines(comment)).split("\n\n")
    return "<br>".join(_escaped(" ".join(paragraph.split())).replace("|", "\\|") for paragraph in paragraphs)


def _escaped(text: str) -> str:
    return text.replace("<", "&lt;").replace("*", "\\*")
