"""Where Redis is: the URL of one server, of Sentinels or of a cluster.

- ``redis://[[user]:password@]host[:port][/db]``: one server, port 6379.
- ``redis+sentinel://[[user]:password@]host[:port],…/master-name[/db]``: the Sentinels, port 26379, and which
  of the masters they watch; with ``?sentinel_username=…&sentinel_password=…`` if the Sentinels ask for them.
- ``redis+cluster://[[user]:password@]host[:port],…``: some nodes of a cluster, port 6379.

``rediss`` instead of ``redis`` is TLS, with ``?ca_file=…`` where the certificates are of no public authority.
What is special in a URL is percent-encoded. Redis itself is not imported here: settings stay light.
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
    """How the servers stand to each other."""

    SINGLE = "single"
    SENTINEL = "sentinel"
    CLUSTER = "cluster"


@dataclass(frozen=True)
class Endpoint:
    """A server to ask."""

    host: str
    """Name or IP address, IPv6 without brackets."""
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"


@dataclass(frozen=True)
class RedisAddress:
    """A Redis, whole; neither ``str`` nor ``repr`` tells its passwords."""

    layout: Layout
    endpoints: tuple[Endpoint, ...]
    """The server, the Sentinels, or nodes of the cluster; at least one."""
    tls: bool = False
    ca_file: str | None = None
    """PEM file of the authorities that are trusted; None: the system's."""
    user: str | None = None
    """None: Redis's "default" user."""
    password: str | None = field(default=None, repr=False)
    """None: none is asked for."""
    database: int = 0
    master_name: str = ""
    """By which the Sentinels know the master; empty where there are none."""
    sentinel_user: str | None = None
    sentinel_password: str | None = field(default=None, repr=False)
    """Of the Sentinels themselves; None: none is asked for."""

    def __str__(self) -> str:
        scheme = "rediss" if self.tls else "redis"
        if self.layout is not Layout.SINGLE:
            scheme += f"+{self.layout.value}"
        path = f"/{self.master_name}" if self.master_name else ""
        if self.database:
            path += f"/{self.database}"
        return f"{scheme}://{','.join(map(str, self.endpoints))}{path}"


def parse_address(text: str) -> RedisAddress:
    """The address that a URL gives.

    Raises:
        ValueError: it gives none. The text says why, but nothing of what was given: anywhere in it there may
            be a password.
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
    # The last "@" is the one before the hosts, as in other parsers; there may be one in the password.
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
    """User and password of USER:PASSWORD or :PASSWORD.

    A lone word is refused, as some take it for the user and some for the password. So is an empty password,
    which would be none where somebody meant to give one.
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
    """Master's name and database."""
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
    """Of ASCII digits, and not of too many; None: it is something else."""
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
