"""LitServe: FastAPI in front of one worker process, which joins calls to batches."""

from typing import Annotated

import litserve
from fastapi import Body, Response

from loadtest.peers.arrays import Arrays, pack, unpack
from loadtest.peers.network import HOST, MAX_CALLS, Network, ServedModel

_WAIT_SECONDS = 0.001
"""Time that a batch waits for more calls."""

Packed = Annotated[bytes, Body(media_type="application/octet-stream")]


class NetworkApi(litserve.LitAPI):
    """API around the network."""

    def setup(self, device: str) -> None:
        """Load the network, in the worker process."""
        self.network = Network(ServedModel.from_flags())

    def decode_request(self, request: Packed) -> Arrays:
        """Return the arrays of a request."""
        return unpack(request)

    def batch(self, inputs: list[Arrays]) -> list[Arrays]:
        """Return the calls as they are; the network joins them."""
        return inputs

    def predict(self, x: list[Arrays]) -> list[Arrays]:
        """Return the answers of a batch."""
        return self.network.batch(x)

    def unbatch(self, output: list[Arrays]) -> list[Arrays]:
        """Return the answers as they are."""
        return output

    def encode_response(self, output: Arrays) -> Response:
        """Return an answer."""
        return Response(pack(output), media_type="application/octet-stream")


if __name__ == "__main__":
    api = NetworkApi(max_batch_size=MAX_CALLS, batch_timeout=_WAIT_SECONDS)
    server = litserve.LitServer(api, accelerator="cpu", workers_per_device=1, fast_queue=True)
    server.run(HOST, ServedModel.from_flags().port, log_level="warning", generate_client_file=False)
