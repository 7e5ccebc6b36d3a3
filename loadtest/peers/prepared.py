"""Prepared tensors of made-up requests, and the forward in process that checks the answers of peers."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from loadtest.peers.arrays import OUTPUTS, Arrays, from_features, to_features
from loadtest.peers.codecs import Codec
from loadtest.requests import Request, difference, scene_of
from model.mixture import TrajectoryMixture
from model.registry import Registry
from model.scenes.scene import AgentType


class PreparedRequests:
    """Requests whose agents are given as tensors, and their forecasts by PyTorch in this process.

    Args:
        models: folder of checkpoints.
        model: name of the network.
        requests: the requests that the tensors are made of.
    """

    def __init__(self, models: Path, model: str, requests: Sequence[Request]) -> None:
        self._forecaster = Registry.load(models).get(model)
        self._requests = requests
        self._arrays: list[Arrays] = []
        self._expected: dict[int, TrajectoryMixture] = {}
        for request in requests:
            scene = scene_of(request.message, self._forecaster.info.history_frames)
            features = self._forecaster.prepare(scene, np.arange(len(scene.types)))
            self._arrays.append(from_features(features))

    def encoded(self, codec: Codec) -> list[Request]:
        """Return the requests with bodies for a peer."""
        return [
            Request(request.message, codec.encode(arrays))
            for request, arrays in zip(self._requests, self._arrays, strict=True)
        ]

    def fault(self, index: int, body: bytes, codec: Codec) -> str:
        """Return how an answer differs from the forward; empty: it does not.

        Args:
            index: number of the request.
            body: body of the answer.
            codec: encoding of the body.
        """
        if index not in self._expected:
            features = to_features(self._arrays[index])
            self._expected[index] = self._forecaster.forecast(features, AgentType.VEHICLE)
        mixture = self._expected[index]
        try:
            answer = codec.decode(body)
        except ValueError as error:
            return str(error)
        expected = (mixture.log_weights, mixture.means, mixture.covariances)
        for name, values in zip(OUTPUTS, expected, strict=True):
            if name not in answer or answer[name].shape != values.shape:
                return f"{name} are missing or of another shape"
        log_weights, means, covariances = (answer[name].astype(np.float64) for name in OUTPUTS)
        ids = [agent.id for agent in self._requests[index].message.agents]
        world = means + mixture.origin.numpy()[:, None, None, :]
        return difference(ids, np.exp(log_weights), world, covariances, mixture)
