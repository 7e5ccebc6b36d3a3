"""Encodings of the peers: what a server reads is what the client wrote, and the other way round."""

from collections.abc import Callable
from typing import Any

import grpc
import numpy as np
import orjson
import pytest

from loadtest.peers.arrays import Arrays, pack, unpack
from loadtest.peers.codecs import Codec, Json, OpenInference, Packed, PackedOpenInference
from loadtest.peers.servers.fastapi_json import Tensor

REQUEST: Arrays = {
    "origin": np.array([[1.5, -2.0]]),
    "first": np.array([[3]]),
    "map": np.arange(12, dtype=np.int8).reshape(1, 3, 2, 2),
}
ANSWER: Arrays = {
    "log_weights": np.array([[-0.5, -1.5]], dtype=np.float32),
    "means": np.arange(8, dtype=np.float32).reshape(1, 2, 2, 2),
}


def read_json(body: bytes) -> Arrays:
    return {name: Tensor(**fields).array() for name, fields in orjson.loads(body).items()}


def write_json(answer: Arrays) -> bytes:
    return orjson.dumps(answer, option=orjson.OPT_SERIALIZE_NUMPY)


def messages() -> Any:
    return grpc.protos("loadtest/peers/open_inference.proto")


def read_typed(body: bytes) -> Arrays:
    request = messages().ModelInferRequest.FromString(body)
    assert request.model_name == "cab"
    types = {"INT8": np.int8, "INT64": np.int64, "FP64": np.float64}
    return {
        given.name: np.frombuffer(raw, dtype=types[given.datatype]).reshape(given.shape)
        for given, raw in zip(request.inputs, request.raw_input_contents, strict=True)
    }


def write_typed(answer: Arrays) -> bytes:
    outputs = [{"name": name, "datatype": "FP32", "shape": array.shape} for name, array in answer.items()]
    contents = [array.tobytes() for array in answer.values()]
    body: bytes = (
        messages().ModelInferResponse(outputs=outputs, raw_output_contents=contents).SerializeToString()
    )
    return body


def read_bytes_tensor(body: bytes) -> Arrays:
    [raw] = messages().ModelInferRequest.FromString(body).raw_input_contents
    assert int.from_bytes(raw[:4], "little") == len(raw) - 4
    return unpack(raw[4:])


def write_bytes_tensor(answer: Arrays) -> bytes:
    packed = pack(answer)
    raw = len(packed).to_bytes(4, "little") + packed
    body: bytes = messages().ModelInferResponse(raw_output_contents=[raw]).SerializeToString()
    return body


@pytest.mark.parametrize(
    ("codec", "read", "write"),
    [
        (Packed(), unpack, pack),
        (Json(), read_json, write_json),
        (OpenInference("cab"), read_typed, write_typed),
        (PackedOpenInference("cab"), read_bytes_tensor, write_bytes_tensor),
    ],
    ids=lambda value: type(value).__name__,
)
def test_both_sides_read_what_the_other_wrote(
    codec: Codec, read: Callable[[bytes], Arrays], write: Callable[[Arrays], bytes]
) -> None:
    for sent, received in ((REQUEST, read(codec.encode(REQUEST))), (ANSWER, codec.decode(write(ANSWER)))):
        assert received.keys() == sent.keys()
        for name, array in sent.items():
            assert received[name].dtype == array.dtype
            np.testing.assert_array_equal(received[name], array)


@pytest.mark.parametrize("codec", [Packed(), Json(), OpenInference("cab"), PackedOpenInference("cab")])
def test_a_malformed_answer_is_a_value_error(codec: Codec) -> None:
    with pytest.raises(ValueError, match=r"."):
        codec.decode(b"\xffnot an answer")
