"""Certificates made for tests."""

from datetime import datetime
from pathlib import Path

import trustme

HOST = "127.0.0.1"


def write_authority(authority: trustme.CA, folder: Path, name: str) -> Path:
    """Write the certificate of an authority; return its file."""
    path = folder / f"{name}.ca.pem"
    authority.cert_pem.write_to_path(path)
    return path


def write_certificate(
    authority: trustme.CA, folder: Path, name: str, *, not_after: datetime | None = None
) -> tuple[Path, Path]:
    """Write a new certificate for this machine and its key; return their files."""
    issued = authority.issue_cert(HOST, not_after=not_after)
    chain, key = folder / f"{name}.pem", folder / f"{name}.key"
    chain.write_bytes(b"".join(pem.bytes() for pem in issued.cert_chain_pems))
    issued.private_key_pem.write_to_path(key)
    return chain, key
