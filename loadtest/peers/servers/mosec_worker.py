"""mosec: a Rust server in front of one worker process, which joins calls to batches."""

import os
from typing import Any

from mosec import Server, Worker

from loadtest.peers.arrays import Arrays, pack, unpack
from loadtest.peers.network import HOST, MAX_CALLS, Network, ServedModel

_WAIT_MS = 1
"""Time that a batch waits for more calls, ms; mosec has no smaller one."""


class NetworkWorker(Worker):
    """Worker around the network."""

    def __init__(self) -> None:
        super().__init__()
        self._network = Network(ServedModel.from_flags())  # a spawned process has the flags of its parent

    def deserialize(self, data: bytes) -> Arrays:
        """Return the arrays of a request."""
        return unpack(bytes(data))  # it is a bytearray

    def serialize(self, data: Arrays) -> bytes:
        """Return the body of an answer."""
        return pack(data)

    def forward(self, data: list[Arrays]) -> Any:
        """Return the answers of a batch."""
        return self._network.batch(data)


if __name__ == "__main__":
    os.environ["MOSEC_ADDRESS"] = HOST
    server = Server()  # reads --port by itself
    server.append_worker(NetworkWorker, max_batch_size=MAX_CALLS, max_wait_time=_WAIT_MS)
    server.run()
