"""Triton (PyTriton): NVIDIA's C++ server with dynamic batching, the network in one Python process."""

from typing import Any

import numpy as np
import torch
from pytriton.decorators import batch
from pytriton.model_config import DynamicBatcher, ModelConfig, Tensor
from pytriton.triton import Triton, TritonConfig

from loadtest.peers.arrays import OUTPUTS, Arrays, from_features
from loadtest.peers.network import HOST, MAX_AGENTS, Network, ServedModel

_INTERVAL_US = 1000
"""Time that a batch waits for more calls, µs."""
_OUTPUT_SHAPES = ((-1,), (-1, -1, 2), (-1, -1, 2, 2))


def main(served: ServedModel) -> None:
    """Serve until the process is terminated."""
    network = Network(served)

    @batch
    def infer(**inputs: np.ndarray[Any, Any]) -> Arrays:
        return network(inputs)

    empty = {name: torch.zeros(1, *shape, dtype=kind) for name, (shape, kind) in network.inputs.items()}
    config = TritonConfig(
        http_address=HOST, grpc_address=HOST, grpc_port=served.port, allow_http=False, allow_metrics=False
    )
    with Triton(config=config) as triton:
        triton.bind(
            model_name=served.model,
            infer_func=infer,
            inputs=[
                Tensor(name=name, dtype=array.dtype.type, shape=array.shape[1:])
                for name, array in from_features(empty).items()
            ],
            outputs=[
                Tensor(name=name, dtype=np.float32, shape=shape)
                for name, shape in zip(OUTPUTS, _OUTPUT_SHAPES, strict=True)
            ],
            config=ModelConfig(
                max_batch_size=MAX_AGENTS, batcher=DynamicBatcher(max_queue_delay_microseconds=_INTERVAL_US)
            ),
            strict=True,
        )
        triton.serve()


if __name__ == "__main__":
    main(ServedModel.from_flags())
