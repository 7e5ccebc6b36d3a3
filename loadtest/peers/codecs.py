"""Encodings of prepared tensors that the peers understand, on the side of the client."""

import base64
import struct
from typing import Any, Protocol

import grpc
import numpy as np
import orjson
from google.protobuf.message import DecodeError

from loadtest.peers.arrays import Arrays, pack, unpack

INFER = "/inference.GRPCInferenceService/ModelInfer"
"""Method of the open inference protocol."""

_DATATYPES = {"int8": "INT8", "int64": "INT64", "float32": "FP32", "float64": "FP64"}
_LENGTH = struct.Struct("<I")
"""Length before each element of a BYTES tensor."""


class Codec(Protocol):
    """Encoding of calls of a peer."""

    def encode(self, arrays: Arrays) -> bytes:
        """Return the body of a request."""

    def decode(self, body: bytes) -> Arrays:
        """Return the arrays of an answer.

        Raises:
            ValueError: the body is malformed.
        """


class Packed:
    """Tensors in the format of safetensors."""

    def encode(self, arrays: Arrays) -> bytes:
        """See ``Codec.encode``."""
        return pack(arrays)

    def decode(self, body: bytes) -> Arrays:
        """See ``Codec.decode``."""
        return unpack(body)


class Json:
    """Tensors in JSON: requests in base64, answers as numbers."""

    def encode(self, arrays: Arrays) -> bytes:
        """See ``Codec.encode``."""
        return orjson.dumps(
            {
                name: {
                    "dtype": str(array.dtype),
                    "shape": array.shape,
                    "data": base64.b64encode(array.tobytes()).decode(),
                }
                for name, array in arrays.items()
            }
        )

    def decode(self, body: bytes) -> Arrays:
        """See ``Codec.decode``."""
        return {name: np.array(values, dtype=np.float32) for name, values in orjson.loads(body).items()}


class OpenInference:
    """Typed tensors of the open inference protocol, as Triton takes them.

    Args:
        model: name of the model in the peer.
    """

    def __init__(self, model: str) -> None:
        self._model = model
        self._messages: Any = grpc.protos("loadtest/peers/open_inference.proto")

    def encode(self, arrays: Arrays) -> bytes:
        """See ``Codec.encode``."""
        inputs = [
            {"name": name, "datatype": _DATATYPES[str(array.dtype)], "shape": array.shape}
            for name, array in arrays.items()
        ]
        return self._request(inputs, [array.tobytes() for array in arrays.values()])

    def decode(self, body: bytes) -> Arrays:
        """See ``Codec.decode``."""
        response = self._response(body)
        return {
            output.name: np.frombuffer(raw, dtype=np.float32).reshape(output.shape)
            for output, raw in zip(response.outputs, response.raw_output_contents, strict=True)
        }

    def _request(self, inputs: list[dict[str, object]], contents: list[bytes]) -> bytes:
        message = self._messages.ModelInferRequest(
            model_name=self._model, inputs=inputs, raw_input_contents=contents
        )
        body: bytes = message.SerializeToString()
        return body

    def _response(self, body: bytes) -> Any:
        try:
            return self._messages.ModelInferResponse.FromString(body)
        except DecodeError as error:
            raise ValueError(f"the answer cannot be parsed: {error}") from error


class PackedOpenInference(OpenInference):
    """One BYTES tensor with all tensors in the format of safetensors, as MLServer's peer takes it."""

    def encode(self, arrays: Arrays) -> bytes:
        """See ``Codec.encode``."""
        packed = pack(arrays)
        inputs: list[dict[str, object]] = [{"name": "request", "datatype": "BYTES", "shape": [1]}]
        return self._request(inputs, [_LENGTH.pack(len(packed)) + packed])

    def decode(self, body: bytes) -> Arrays:
        """See ``Codec.decode``."""
        [raw] = self._response(body).raw_output_contents
        return unpack(raw[_LENGTH.size :])
