"""File of API keys: names, hashes, scopes and limits, as JSON.

A key is made of 256 random bits, so a plain SHA-256 of it cannot be inverted, and whoever reads the file
gains no access. Slow, salted hashes are for passwords that people choose.
"""

import hashlib
import os
import secrets
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from service.access.scopes import Scope

MAX_KEYS = 256
"""Max number of keys in a file. Each is compared with every call's, and has metrics of its own."""
PREFIX = "cabf_"
"""Beginning of every key, so that scanners for leaked secrets can find them."""
_KEY_BYTES = 32
_MODE = 0o644
_NAME = r"^[a-z0-9][a-z0-9._-]{0,63}$"


class KeyFileError(Exception):
    """Error of a file of keys; the text says what is wrong and holds neither keys nor hashes."""


class Key(BaseModel):
    """A key: who holds it, and what it may do."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: Annotated[str, Field(pattern=_NAME)]
    """Name of the holder, for logs and metrics: lower-case letters, digits, dots, dashes, underscores."""
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$", repr=False)]
    """SHA-256 of the key, in hexadecimal."""
    scopes: tuple[Scope, ...]
    agents_per_second: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None
    """Max rate of agents in requests, on average over a second; None: no limit of its own."""
    concurrent_agents: Annotated[int, Field(ge=1)] | None = None
    """Max number of agents in requests in progress; None: no limit of its own."""
    streams: Annotated[int, Field(ge=0)] | None = None
    """Max number of open streams of events; None: no limit of its own."""
    created: datetime | None = None
    """Time at which the key was made."""


class _KeyFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    keys: Annotated[tuple[Key, ...], Field(max_length=MAX_KEYS)]

    @model_validator(mode="after")
    def _tells_keys_apart(self) -> "_KeyFile":
        for attribute in ("name", "sha256"):
            values = [getattr(key, attribute) for key in self.keys]
            if len(set(values)) < len(values):
                raise ValueError(f"two keys have the same {attribute}")
        return self


def digest(key: str) -> str:
    """Return the hash of a key, as the file holds it."""
    return hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()


def new_key(name: str, scopes: Sequence[Scope], **limits: float | int | None) -> tuple[str, Key]:
    """Make a random key.

    Args:
        name: name of the holder.
        scopes: the scopes.
        limits: limits of ``Key``, by attribute.

    Returns:
        The key itself, which is kept nowhere, and its entry for the file.

    Raises:
        KeyFileError: the name or a limit is invalid.
    """
    text = PREFIX + secrets.token_urlsafe(_KEY_BYTES)
    entry = {"name": name, "sha256": digest(text), "scopes": scopes, "created": _now(), **limits}
    try:
        return text, Key.model_validate(entry)
    except ValidationError as error:
        raise KeyFileError(_describe(error)) from None


def read_keys(path: Path) -> tuple[Key, ...]:
    """Return the keys of a file.

    Raises:
        KeyFileError: the file is missing or invalid.
    """
    try:
        return _KeyFile.model_validate_json(path.read_bytes()).keys
    except OSError as error:
        raise KeyFileError(f"{path}: {error.strerror or error}") from error
    except ValidationError as error:
        raise KeyFileError(f"{path}: {_describe(error)}") from None


def write_keys(path: Path, keys: Sequence[Key]) -> None:
    """Replace a file of keys as a whole, so that a server never reads half of it.

    Raises:
        KeyFileError: there are too many keys, two have the same name, or the file cannot be written.
    """
    try:
        text = _KeyFile(keys=tuple(keys)).model_dump_json(indent=2, exclude_none=True)
    except ValidationError as error:
        raise KeyFileError(_describe(error)) from None
    try:
        mode = path.stat().st_mode & 0o777 if path.exists() else _MODE
        with tempfile.NamedTemporaryFile("w", dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            temporary = Path(file.name)
            try:
                file.write(text + "\n")
                os.fchmod(file.fileno(), mode)
                file.flush()
                os.fsync(file.fileno())
                temporary.replace(path)
            except BaseException:
                temporary.unlink(missing_ok=True)
                raise
    except OSError as error:
        raise KeyFileError(f"{path}: {error.strerror or error}") from error


def _now() -> datetime:
    return datetime.now(UTC).replace(microsecond=0)


def _describe(error: ValidationError) -> str:
    """Return what is wrong, without the values that are."""
    problems = (
        (".".join(map(str, problem["loc"])), problem["msg"].removeprefix("Value error, "))
        for problem in error.errors(include_input=False, include_url=False)
    )
    return "; ".join(f"{place}: {text}" if place else text for place, text in problems)
