"""The peers: how each is started, called and described."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from cab.forecast.v1.routes import PREDICT
from loadtest.peers.codecs import INFER, Codec, Json, OpenInference, Packed, PackedOpenInference
from loadtest.wire import GrpcWire, RestWire, Wire

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENTS = ROOT / ".venv-peers"
"""Folder of the peers' environments; ``make peers-install`` makes them of ``requirements-NAME.txt``."""


@dataclass(frozen=True)
class Peer:
    """Another server around the same network."""

    title: str
    module: str
    """Module of ``loadtest.peers.servers`` that its process runs."""
    package: str
    """Package that it is made of."""
    connect: Callable[[str], Wire]
    """Function that connects to HOST:PORT."""
    codec: Callable[[str], Codec] | None
    """Maker of its encoding, given the name of the model; None: it gets our requests."""
    batches: str
    """Explanation of how it joins calls."""


PEERS: Mapping[str, Peer] = {
    "grpc-aio": Peer(
        "grpc.aio + lock",
        "grpc_aio",
        "grpc",
        lambda address: GrpcWire(address, "/peer.Network/Forecast"),
        lambda _: Packed(),
        "no",
    ),
    "grpc-raw": Peer(
        "grpc.aio + lock, our request",
        "grpc_raw",
        "grpc",
        lambda address: GrpcWire(address, PREDICT.rpc),
        None,
        "no",
    ),
    "fastapi": Peer(
        "FastAPI + JSON",
        "fastapi_json",
        "fastapi",
        lambda address: RestWire(address, "application/json", "/forecast"),
        lambda _: Json(),
        "no",
    ),
    "mosec": Peer(
        "mosec",
        "mosec_worker",
        "mosec",
        lambda address: RestWire(address, "application/octet-stream", "/inference"),
        lambda _: Packed(),
        "up to 16 calls or 1 ms",
    ),
    "mlserver": Peer(
        "MLServer",
        "mlserver_runtime",
        "mlserver",
        lambda address: GrpcWire(address, INFER),
        PackedOpenInference,
        "up to 16 calls or 1 ms",
    ),
    "litserve": Peer(
        "LitServe",
        "litserve_api",
        "litserve",
        lambda address: RestWire(address, "application/octet-stream", "/predict"),
        lambda _: Packed(),
        "up to 16 calls or 1 ms",
    ),
    "pytriton": Peer(
        "Triton (PyTriton)",
        "pytriton_model",
        "pytriton",
        lambda address: GrpcWire(address, INFER),
        OpenInference,
        "up to 128 agents or 1 ms",
    ),
}
"""Peers by name."""


def interpreter(name: str) -> str | None:
    """Return the Python that runs a peer: of its environment, else this one; None: its package is missing."""
    own = ENVIRONMENTS / name / "bin/python"
    if own.is_file():
        return str(own)
    return sys.executable if find_spec(PEERS[name].package) is not None else None
