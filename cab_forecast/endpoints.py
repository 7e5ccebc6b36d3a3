"""Endpoints of servers. The command line imports this at its start, so it imports nothing heavy."""

import ipaddress
from dataclasses import dataclass
from typing import Literal
from urllib.parse import urlsplit

DEFAULT_ENDPOINT = "grpc://127.0.0.1:50051"
"""Address that `cab-forecast serve` listens on by default."""
_DEFAULT_GRPC_PORT = 50051
_SCHEMES = ("grpc", "grpcs", "dns", "http", "https")


@dataclass(frozen=True)
class Endpoint:
    """Address of a server."""

    url: str
    """URL for people, e.g. ``grpc://127.0.0.1:50051``; without credentials."""
    transport: Literal["grpc", "rest"]
    secure: bool
    """True if the connection uses TLS."""
    target: str
    """``host:port`` or ``dns://…`` for gRPC; the base URL, without a trailing slash, for REST."""
    host: str
    """Name or address of the server, IPv6 in brackets."""

    @property
    def is_loopback(self) -> bool:
        """True if the server is on this machine, so that no proxy leads to it."""
        try:
            return ipaddress.ip_address(self.host.strip("[]")).is_loopback
        except ValueError:
            return self.host == "localhost"


def parse_endpoint(endpoint: str) -> Endpoint:
    """Parse ``grpc://host:port``, ``grpcs://``, ``http://`` or ``https://``; bare ``host:port`` is gRPC.

    gRPC's own ``dns:///host:port`` means the same as ``grpc://host:port``; ``dns://resolver/host:port`` asks
    the DNS server ``resolver``. The port may be omitted: 50051 for gRPC, the scheme's own for HTTP. An HTTP
    URL may have a path, for gateways that serve the REST interface below one.

    Raises:
        ValueError: unknown scheme, no host, invalid port, or parts that an endpoint cannot have.
    """
    address = endpoint if "://" in endpoint else f"grpc://{endpoint}"
    resolver = ""
    if address.startswith("dns://"):
        resolver, slash, name = address.removeprefix("dns://").partition("/")
        if not slash:
            raise ValueError(f"endpoint {endpoint!r}: no host; gRPC's spelling is dns:///host:port")
        address = f"grpc://{name}"
    parts = urlsplit(address)
    if parts.scheme not in _SCHEMES:
        expected = ", ".join(f"{scheme}://" for scheme in _SCHEMES)
        raise ValueError(
            f"endpoint {endpoint!r}: unknown scheme {parts.scheme!r}, expected one of {expected}"
        )
    try:
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ValueError(f"endpoint {endpoint!r}: {error}") from error
    if not host:
        raise ValueError(f"endpoint {endpoint!r}: no host")
    if parts.username is not None or parts.query or parts.fragment:
        raise ValueError(f"endpoint {endpoint!r}: only scheme, host, port and, for HTTP, a path are allowed")
    if ":" in host:  # IPv6 addresses keep their brackets
        host = f"[{host}]"
    path = parts.path.rstrip("/")
    if parts.scheme in ("grpc", "grpcs"):
        if path:
            raise ValueError(f"endpoint {endpoint!r}: a gRPC endpoint has no path")
        target = f"{host}:{port or _DEFAULT_GRPC_PORT}"
        if resolver:
            target = f"dns://{resolver}/{target}"
            return Endpoint(target, "grpc", False, target, host)
        return Endpoint(f"{parts.scheme}://{target}", "grpc", parts.scheme == "grpcs", target, host)
    url = f"{parts.scheme}://{host}{f':{port}' if port else ''}{path}"
    return Endpoint(url, "rest", parts.scheme == "https", url, host)
