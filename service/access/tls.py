"""Certificates of the server, and of the authority that signs its clients'."""

import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from service.access.watched import Watched
from service.settings import Settings


class TlsError(Exception):
    """Error of certificates that cannot be used; the text says why."""


@dataclass(frozen=True)
class Certificates:
    """Contents of the files, and the context that they give for TLS in Python."""

    chain: bytes
    """PEM certificates of the server, its own first."""
    key: bytes
    """PEM private key."""
    client_ca: bytes | None
    """PEM certificates of the authorities of clients; None: clients need no certificate."""
    context: ssl.SSLContext


def watch_certificates(settings: Settings) -> Watched[Certificates] | None:
    """Return the certificates that the settings name; None: the server speaks plain HTTP and gRPC.

    Raises:
        TlsError: a file is missing or broken, or the key does not belong to the certificate.
    """
    chain, key, client_ca = settings.tls_certificate, settings.tls_key, settings.tls_client_ca
    if chain is None or key is None:
        return None
    paths = [path for path in (chain, key, client_ca) if path is not None]
    return Watched("certificates", paths, lambda: read_certificates(chain, key, client_ca))


def read_certificates(chain: Path, key: Path, client_ca: Path | None) -> Certificates:
    """Return the certificates of some PEM files.

    Raises:
        TlsError: a file is missing or broken, or the key does not belong to the certificate.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.set_alpn_protocols(["http/1.1"])
    # Resumed sessions would outlive the authority that signed the client's certificate.
    context.options |= ssl.OP_NO_TICKET | ssl.OP_NO_COMPRESSION | ssl.OP_NO_RENEGOTIATION
    context.num_tickets = 0
    contents = _read(chain), _read(key)
    try:
        context.load_cert_chain(chain, key, _refuse_password)
    except (ssl.SSLError, OSError) as error:
        raise TlsError(f"{chain} and {key} are no certificate and its key: {_reason(error)}") from error
    authorities = None
    if client_ca is not None:
        authorities = _read(client_ca)
        try:
            context.load_verify_locations(client_ca)
        except (ssl.SSLError, OSError) as error:
            raise TlsError(f"{client_ca} holds no certificates: {_reason(error)}") from error
        context.verify_mode = ssl.CERT_REQUIRED
    return Certificates(*contents, authorities, context)


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise TlsError(f"{path}: {error.strerror or error}") from error


def _refuse_password() -> NoReturn:
    """Refuse an encrypted key: OpenSSL would ask the terminal for its password."""
    raise TlsError("the private key is encrypted: give one without a password")


def _reason(error: OSError) -> str:
    return getattr(error, "reason", None) or error.strerror or str(error)
