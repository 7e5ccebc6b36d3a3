"""FastAPI with JSON and one lock around the forward.

Requests hold tensors in base64, since maps as lists of numbers would take a second to parse; answers hold
lists of numbers.
"""

import base64
import threading

import numpy as np
import orjson
import uvicorn
from fastapi import FastAPI, Response
from pydantic import BaseModel

from loadtest.peers.network import HOST, Network, ServedModel

PATH = "/forecast"


class Tensor(BaseModel):
    """A tensor in JSON."""

    dtype: str
    shape: list[int]
    data: str
    """Bytes of the elements in C order, in base64."""

    def array(self) -> "np.ndarray[tuple[int, ...], np.dtype[np.generic]]":
        """Return the tensor as an array."""
        return np.frombuffer(base64.b64decode(self.data), dtype=self.dtype).reshape(self.shape)


def application(network: Network) -> FastAPI:
    """Return the application around a network."""
    app, lock = FastAPI(), threading.Lock()

    @app.post(PATH)
    def forecast(tensors: dict[str, Tensor]) -> Response:
        arrays = {name: tensor.array() for name, tensor in tensors.items()}
        with lock:
            answer = network(arrays)
        body = orjson.dumps(answer, option=orjson.OPT_SERIALIZE_NUMPY)
        return Response(body, media_type="application/json")

    return app


def main(served: ServedModel) -> None:
    """Serve until the process is terminated."""
    uvicorn.run(application(Network(served)), host=HOST, port=served.port, log_level="warning")


if __name__ == "__main__":
    main(ServedModel.from_flags())
