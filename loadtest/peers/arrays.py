"""Prepared tensors on their way between a client and a peer: arrays, and these as bytes."""

from typing import Any, TypeAlias

import numpy as np
import safetensors.numpy
import torch

from model.forecaster import Features
from model.mixture import TrajectoryMixture

Arrays: TypeAlias = dict[str, np.ndarray[Any, Any]]
"""Arrays by name; the first axis of each is the agents'."""

OUTPUTS = ("log_weights", "means", "covariances")
"""Answer of a peer, float32: [N, K], [N, K, T, 2] relative to the agent's position, [N, K, T, 2, 2]."""

_MAPS = ("map", "far_map")
_MAP_SCALE = 127
"""Value of a byte that stands for 1."""


def from_features(features: Features) -> Arrays:
    """Return features as arrays to send, each with two axes or more.

    Maps become bytes, as a client would send images: a quarter of the size, which spares the peers' time.
    """
    arrays = {name: tensor.numpy() for name, tensor in features.items()}
    for name in _MAPS:
        if name in arrays:
            arrays[name] = np.round(_MAP_SCALE * arrays[name]).astype(np.int8)
    return {
        name: array.reshape(len(array), -1) if array.ndim == 1 else array for name, array in arrays.items()
    }


def to_features(arrays: Arrays) -> Features:
    """Return the features that were sent as arrays."""
    features = {}
    for name, array in arrays.items():
        if name in _MAPS:
            features[name] = torch.from_numpy(array.astype(np.float32) / np.float32(_MAP_SCALE))
        else:
            features[name] = torch.from_numpy(
                np.array(array.reshape(-1) if array.shape[1:] == (1,) else array)
            )
    return features


def from_mixture(mixture: TrajectoryMixture) -> Arrays:
    """Return the arrays of an answer."""
    parts = (mixture.log_weights, mixture.means, mixture.covariances)
    return {name: part.contiguous().numpy() for name, part in zip(OUTPUTS, parts, strict=True)}


def join(parts: list[Arrays]) -> Arrays:
    """Return the arrays of the agents of all parts."""
    if len(parts) == 1:
        return parts[0]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def split(arrays: Arrays, counts: list[int]) -> list[Arrays]:
    """Return the arrays of the agents of each part.

    Args:
        arrays: arrays of all agents.
        counts: number of agents of each part.
    """
    ends = np.cumsum(counts).tolist()
    return [
        {name: array[end - count : end] for name, array in arrays.items()}
        for end, count in zip(ends, counts, strict=True)
    ]


def pack(arrays: Arrays) -> bytes:
    """Return arrays as bytes, in the format of safetensors."""
    return safetensors.numpy.save({name: np.ascontiguousarray(array) for name, array in arrays.items()})


def unpack(body: bytes) -> Arrays:
    """Return the arrays of bytes in the format of safetensors.

    Raises:
        ValueError: the bytes are malformed.
    """
    try:
        arrays: Arrays = safetensors.numpy.load(body)
    except safetensors.SafetensorError as error:
        raise ValueError(f"not in the format of safetensors: {error}") from error
    return arrays
