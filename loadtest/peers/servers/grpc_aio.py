"""grpc.aio with one lock around the forward: the server that a team writes first."""

import asyncio

import grpc
from grpc import aio

from loadtest.peers.arrays import pack, unpack
from loadtest.peers.network import HOST, Network, ServedModel

SERVICE, METHOD = "peer.Network", "Forecast"


async def main(served: ServedModel) -> None:
    """Serve until the process is terminated."""
    network, lock = Network(served), asyncio.Lock()

    async def forecast(body: bytes, _: object) -> bytes:
        arrays = unpack(body)
        async with lock:
            answer = await asyncio.to_thread(network, arrays)
        return pack(answer)

    server = aio.server(
        options=[("grpc.max_receive_message_length", -1), ("grpc.max_send_message_length", -1)]
    )
    methods = {METHOD: grpc.unary_unary_rpc_method_handler(forecast)}
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, methods),))
    server.add_insecure_port(f"{HOST}:{served.port}")
    await server.start()
    await server.wait_for_termination()


if __name__ == "__main__":
    asyncio.run(main(ServedModel.from_flags()))
