"""MLServer: the open inference protocol over gRPC, in one process, with adaptive batching.

A call has one input of type BYTES with the packed tensors. As typed tensors, MLServer would turn every
number into a Python object.
"""

import asyncio

from mlserver import MLModel, MLServer, ModelSettings, Settings
from mlserver.types import InferenceRequest, InferenceResponse, ResponseOutput

from loadtest.peers.arrays import pack, unpack
from loadtest.peers.network import HOST, MAX_CALLS, Network, ServedModel

_WAIT_SECONDS = 0.001
"""Time that a batch waits for more calls."""


class NetworkRuntime(MLModel):
    """Runtime around the network."""

    async def load(self) -> bool:
        """Load the network."""
        self._network, self._lock = Network(ServedModel.from_flags()), asyncio.Lock()
        return True

    async def predict(self, payload: InferenceRequest) -> InferenceResponse:
        """Return the answers of a batch."""
        calls = [unpack(body) for body in payload.inputs[0].data]
        async with self._lock:
            answers = await asyncio.to_thread(self._network.batch, calls)
        data = [pack(answer) for answer in answers]
        output = ResponseOutput(name="answer", shape=[len(data)], datatype="BYTES", data=data)
        return InferenceResponse(model_name=self.name, outputs=[output])


async def main(served: ServedModel) -> None:
    """Serve until the process is terminated."""
    # The REST and metrics servers cannot be left out; port 0 gives them free ones
    server = MLServer(
        Settings(
            host=HOST,
            http_port=0,
            grpc_port=served.port,
            metrics_endpoint=None,
            parallel_workers=0,
            debug=False,
            grpc_max_message_length=-1,
        )
    )
    model = ModelSettings(
        name=served.model,
        implementation=NetworkRuntime,
        max_batch_size=MAX_CALLS,
        max_batch_time=_WAIT_SECONDS,
    )
    await server.start([model])


if __name__ == "__main__":
    asyncio.run(main(ServedModel.from_flags()))
