"""The comments of the .proto files, which generated code does not carry: REST's documentation."""

import functools
import re
from importlib import resources

_BLOCK = re.compile(r"(message|enum|service|oneof)\s+(\w+)\s*\{(\s*\})?")
_RPC = re.compile(r"rpc\s+(\w+)\s*\(")
_FIELD = re.compile(r"(?:optional\s+|repeated\s+)?(?:map<[^>]*>|[\w.]+)\s+(\w+)\s*=\s*\d+")
_VALUE = re.compile(r"([A-Z][A-Z0-9_]*)\s*=\s*\d+\s*;")


@functools.cache
def comments(package: str = "cab.forecast.v1") -> dict[str, str]:
    """What is written above each message, field, enum, value and method.

    Args:
        package: of the .proto files, which is a Python package too.

    Returns:
        By name within the package, e.g. "PredictRequest.time", "PredictionService.Predict"; a field of a
        oneof stands under its message. One line a paragraph.
    """
    found: dict[str, str] = {}
    for file in resources.files(package).iterdir():
        if file.name.endswith(".proto"):
            found |= parse_comments(file.read_text(encoding="utf-8"))
    return found


def parse_comments(source: str) -> dict[str, str]:
    """As ``comments``, of one file, written as `buf format` writes it: a declaration a line."""
    found: dict[str, str] = {}
    scope: list[str | None] = []  # None: a block whose members belong to the block around it
    lines: list[str] = []
    for line in map(str.strip, source.splitlines()):
        if line.startswith("//"):
            lines.append(line.removeprefix("//").strip())
            continue
        text, lines = " ".join(lines), []
        block = _BLOCK.match(line)
        declared = _RPC.match(line) or (scope and (_VALUE.match(line) or _FIELD.match(line))) or None
        if block and block[1] != "oneof":
            name = block[2]
        elif declared:
            name = declared[1]
        else:
            name = ""
        if name and text:
            found[".".join([part for part in scope if part] + [name])] = text
        if block and not block[3]:
            scope.append(None if block[1] == "oneof" else block[2])
        elif line == "}" and scope:
            scope.pop()
    return found
