"""Parsing of Redis URLs: of one server, of Sentinels or of a cluster.

- ``redis://[[user]:password@]host[:port][/db]``: one server, port 6379.
- ``redis+sentinel://[[user]:password@]host[:port],…/master-name[/db]``: the Sentinels, port 26379, and the
  name of the master; with ``?sentinel_username=…&sentinel_password=…`` if the Sentinels require them.
- ``redis+cluster://[[user]:password@]host[:port],…``: some nodes of a cluster, port 6379.

``rediss`` instead of ``redis`` means TLS, with ``?ca_file=…`` for certificates of a private authority.
Special characters are percent-encoded. The redis package is not imported here, so that settings load fast.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from ipaddress import IPv6Address
from urllib.parse import unquote

_PORT = 6379
_SENTINEL_PORT = 26379
_MAX_PORT = 65535

_SCHEME = re.compile(r"(rediss?)(?:\+(sentinel|cluster))?")
_HOST = re.compile(r"[A-Za-z0-9._-]+")
_MASTER = re.compile(r"[A-Za-z0-9._-]+")
_STRAY_PERCENT = re.compile(r"%(?![0-9A-Fa-f]{2})")
_UNPRINTED = re.compile(r"[\x00-\x20\x7f]")


class Layout(Enum):
    """Layout of the Redis deployment."""

    SINGLE = "single"
    SENTINEL = "sentinel"
    CLUSTER = "cluster"


@dataclass(frozen=True)
class Endpoint:
    """Host and port of a server."""

    host: str
    """Name or IP address, IPv6 without brackets."""
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


@dataclass(frozen=True)
class RedisAddress:
    """Address of a Redis deployment; ``str`` and ``repr`` omit its passwords."""

    layout: Layout
    endpoints: tuple[Endpoint, ...]
    """The server, the Sentinels or nodes of the cluster; at least one."""
    tls: bool = False
    ca_file: str | None = None
    """PEM file of the trusted authorities; None: those of the system."""
    user: str | None = None
    """User; None: Redis's "default" user."""
    password: str | None = field(default=None, repr=False)
    """Password; None: none is required."""
    database: int = 0
    master_name: str = ""
    """Name of the master at the Sentinels; empty without Sentinels."""
    sentinel_user: str | None = None
    sentinel_password: str | None = field(default=None, repr=False)
    """Password of the Sentinels themselves; None: none is required."""

    def __str__(self) -> str:
        scheme = "rediss" if self.tls else "redis"
        if self.layout is not Layout.SINGLE:
            scheme += f"+{self.layout.value}"
        path = f"/{self.master_name}" if self.master_name else ""
        if self.database:
            path += f"/{self.database}"
        return f"{scheme}://{','.join(map(str, self.endpoints))}{path}"


def parse_address(text: str) -> RedisAddress:
    """Return the address that a URL encodes.

    Raises:
        ValueError: the URL is invalid. The text says why but quotes nothing of the URL, because any part of
            it may be a password.
    """
    if _UNPRINTED.search(text):
        raise ValueError("a Redis URL has no blanks; percent-encode them")
    if "#" in text:
        raise ValueError('a Redis URL has no "#"; in a password write %23')
    scheme, separator, rest = text.partition("://")
    matched = _SCHEME.fullmatch(scheme.lower())
    if not separator or matched is None:
        raise ValueError(
            "is no URL of a Redis: it begins with redis://, redis+sentinel:// or redis+cluster://, "
            "and for TLS with rediss"
        )
    layout = Layout(matched[2] or "single")
    tls = matched[1] == "rediss"
    location, _, query = rest.partition("?")
    authority, _, path = location.partition("/")
    # The last "@" ends the credentials, as in other parsers; the password may contain another.
    credentials, at, hosts = authority.rpartition("@")
    user, password = _parse_credentials(credentials) if at else (None, None)
    parameters = _parse_query(query)
    master_name, database = _parse_path(layout, path)
    address = RedisAddress(
        layout=layout,
        endpoints=tuple(_parse_hosts(layout, hosts)),
        tls=tls,
        ca_file=parameters.pop("ca_file", None) if tls else None,
        user=user,
        password=password,
        database=database,
        master_name=master_name,
        sentinel_user=parameters.pop("sentinel_username", None) if layout is Layout.SENTINEL else None,
        sentinel_password=parameters.pop("sentinel_password", None) if layout is Layout.SENTINEL else None,
    )
    if parameters:
        raise ValueError(
            "a Redis URL has no other parameters than ca_file, with rediss, "
            "and sentinel_username and sentinel_password, with +sentinel"
        )
    if address.sentinel_user is not None and address.sentinel_password is None:
        raise ValueError("the Redis URL has a sentinel_username but no sentinel_password")
    return address


def _parse_credentials(text: str) -> tuple[str | None, str]:
    """Return user and password of USER:PASSWORD or :PASSWORD.

    A single word is refused, because some parsers take it for the user and some for the password. An empty
    password is refused too: it would mean no password where one was intended.
    """
    user, colon, password = text.partition(":")
    if not colon or not password:
        raise ValueError('the Redis URL has no password before its "@"; it is user:password@ or :password@')
    return _decode(user) or None, _decode(password)


def _parse_hosts(layout: Layout, text: str) -> Iterator[Endpoint]:
    hosts = text.split(",")
    if len(hosts) > 1 and layout is Layout.SINGLE:
        raise ValueError("several hosts need redis+sentinel:// or redis+cluster://")
    default = _SENTINEL_PORT if layout is Layout.SENTINEL else _PORT
    for host in hosts:
        yield _parse_host(host, default)


def _parse_host(text: str, default_port: int) -> Endpoint:
    if text.startswith("["):
        host, bracket, port = text[1:].partition("]")
        valid = bool(bracket) and _is_ipv6(host) and (not port or port.startswith(":"))
        colon, port = port[:1], port[1:]
    else:
        host, colon, port = text.partition(":")
        valid = _HOST.fullmatch(host) is not None
    if not valid:
        raise ValueError("the Redis URL names no valid host; it is HOST, HOST:PORT or [IPV6]:PORT")
    return Endpoint(host, _parse_port(port) if colon else default_port)


def _parse_port(text: str) -> int:
    port = _parse_number(text)
    if port is None or not 0 < port <= _MAX_PORT:
        raise ValueError(f"the port in the Redis URL is no number from 1 to {_MAX_PORT}")
    return port


def _parse_path(layout: Layout, text: str) -> tuple[str, int]:
    """Return the master's name, "" without Sentinels, and the number of the database.

    Raises:
        ValueError: the path does not fit the layout.
    """
    parts = text.removesuffix("/").split("/") if text else []
    if layout is Layout.CLUSTER:
        if any(parts):
            raise ValueError("redis+cluster:// has no path: a cluster has one database")
        return "", 0
    master = ""
    if layout is Layout.SENTINEL:
        master = parts.pop(0) if parts else ""
        if not _MASTER.fullmatch(master):
            raise ValueError("redis+sentinel:// needs the master's name: …host:port/master-name")
    if not any(parts):
        return master, 0
    database = _parse_number(parts[0]) if len(parts) == 1 else None
    if database is None:
        raise ValueError("the path of the Redis URL is no number of a database")
    return master, database


def _parse_number(text: str) -> int | None:
    """Return the number of up to nine ASCII digits; None if the text is anything else."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) <= 9 else None


def _parse_query(text: str) -> dict[str, str]:
    parameters: dict[str, str] = {}
    for part in text.split("&") if text else []:
        name, equals, value = part.partition("=")
        if not equals or not value or name in parameters:
            raise ValueError("each parameter of the Redis URL has one value: name=value")
        parameters[name] = _decode(value)
    return parameters


def _decode(text: str) -> str:
    if _STRAY_PERCENT.search(text):
        raise ValueError('the Redis URL has a "%" that encodes nothing; write %25')
    try:
        return unquote(text, errors="strict")
    except UnicodeDecodeError:
        raise ValueError("the Redis URL percent-encodes something that is no UTF-8") from None


def _is_ipv6(text: str) -> bool:
    try:
        IPv6Address(text)
    except ValueError:
        return False
    return True
