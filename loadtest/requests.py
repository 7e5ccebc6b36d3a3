"""Requests of made-up scenes, encoded once, and the forward in process that checks their answers."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path

import numpy as np
import torch
from google.protobuf import json_format
from google.protobuf.message import DecodeError, Message

from cab.forecast.v1.prediction_service_pb2 import PredictRequest, PredictResponse, SceneRaster
from cab_forecast import predict_request, raster_digest, scene_raster
from loadtest.forward import paired_seconds
from loadtest.traffic import FIELD, START, STEP, Traffic
from model.arrays import Floats
from model.forecaster import Features, Forecaster, join
from model.mixture import TrajectoryMixture
from model.registry import Registry
from model.scenes.observations import Observations
from model.scenes.resample import resample
from model.scenes.scene import AgentType, Raster, Scene

SCENES = 8
"""Number of different requests, which calls use in turn."""
STATES = 5
"""States in an agent's history."""
PIXELS = FIELD
"""Rows and columns of the raster, one pixel per metre: the field of the traffic."""
MAX_POSITION_ERROR = 1e-3
"""m; max difference of a mean, or of the root of a variance, from the forward in process."""
MAX_WEIGHT_ERROR = 1e-4

_MIN_RAW_AGENTS = 128
"""Batches of at least so many agents are tried for the best rate of the raw forward."""


class Encoding(StrEnum):
    """Encodings of requests and answers."""

    PROTOBUF = "protobuf"
    JSON = "json"

    @property
    def media_type(self) -> str:
        """Media type in HTTP headers."""
        return "application/json" if self is Encoding.JSON else "application/x-protobuf"


class Map(StrEnum):
    """Forms of the map in requests."""

    RASTER = "raster"
    """The whole raster in each call."""
    DIGEST = "digest"
    """Its digest; the raster is sent whole only to a server that does not have it."""


@dataclass(frozen=True)
class Request:
    """A request and its encoded forms."""

    message: PredictRequest
    """The request with its whole raster."""
    body: bytes
    """Body to send."""
    whole: bytes = b""
    """Body for a server that does not have the raster; empty: the raster is in each body."""


def made_up_requests(
    model: str,
    agents: int,
    encoding: Encoding = Encoding.PROTOBUF,
    form: Map = Map.RASTER,
    scenes: int = SCENES,
) -> list[Request]:
    """Return requests of different scenes, each with vehicles and a raster, for all modes.

    Args:
        model: requested model.
        agents: vehicles per scene.
        encoding: encoding of the bodies.
        form: form of the map in the bodies.
        scenes: number of scenes.
    """
    requests = []
    for seed in range(scenes):
        now = START + seed * STEP
        traffic = Traffic(agents, seed)
        message = predict_request(
            now,
            traffic.agents(now, STATES),
            model=model,
            raster=scene_raster(traffic.roads(), (0.0, 0.0), 1.0),
            merge=False,
        )
        requests.append(_encoded(message, encoding, form))
    return requests


def _encoded(message: PredictRequest, encoding: Encoding, form: Map) -> Request:
    if form is Map.RASTER:
        return Request(message, encode(message, encoding))
    digest = raster_digest(message.scene_raster)
    message.scene_raster.digest = digest
    named = PredictRequest()
    named.CopyFrom(message)
    named.scene_raster.CopyFrom(SceneRaster(digest=digest))
    return Request(message, encode(named, encoding), encode(message, encoding))


def encode(message: Message, encoding: Encoding) -> bytes:
    """Return a request or response in an encoding."""
    if encoding is Encoding.PROTOBUF:
        return message.SerializeToString()
    return json_format.MessageToJson(message, indent=None).encode()


def decode(body: bytes, encoding: Encoding) -> PredictResponse:
    """Return the message of an answer.

    Raises:
        ValueError: the body cannot be parsed.
    """
    try:
        if encoding is Encoding.PROTOBUF:
            return PredictResponse.FromString(body)
        return json_format.Parse(body, PredictResponse())
    except (DecodeError, json_format.ParseError, UnicodeDecodeError) as error:
        raise ValueError(f"the answer cannot be parsed: {error}") from error


class ForwardInProcess:
    """The forward of the requested model in this process: reference of the answers, and of the speed.

    Args:
        models: folder of the server's checkpoints.
        model: requested model.
        requests: the requests.
    """

    def __init__(self, models: Path, model: str, requests: Sequence[Request]) -> None:
        self._reference = Registry.load(models).get(model)
        self._timed: Forecaster | None = None
        self._models = models
        self._requests = requests
        self._expected: dict[int, TrajectoryMixture] = {}

    def fault(self, index: int, body: bytes, encoding: Encoding) -> str:
        """Return how an answer differs from the forward; empty: it does not.

        Args:
            index: number of the request.
            body: body of the answer.
            encoding: encoding of the body.
        """
        try:
            answer = decode(body, encoding)
        except ValueError as error:
            return str(error)
        message = self._requests[index].message
        if [forecast.agent_id for forecast in answer.forecasts] != [agent.id for agent in message.agents]:
            return "the answer is of other agents"
        if index not in self._expected:
            scene = scene_of(message, self._reference.info.history_frames)
            self._expected[index] = self._reference(scene, np.arange(len(scene.types)))
        return _difference(answer, self._expected[index])

    def best_rate(self, engine: str, threads: int | None, seconds: float) -> float:
        """Return the agents/s of the raw forward in the batch size that is the fastest.

        Args:
            engine: engine of the server.
            threads: threads of the server's forward; None: all cores.
            seconds: seconds to measure each batch size.
        """
        if self._timed is None:
            info = self._reference.info
            self._timed = Registry.load(self._models).get(info.full_name)
            if engine != "eager":
                self._timed.compile(threads or torch.get_num_threads())
        kind = AgentType.VEHICLE
        batches = list(self._batches(self._timed))
        with torch.inference_mode():
            times = paired_seconds(
                *(partial(self._timed.forecast, features, kind) for features in batches), seconds=seconds
            )
        return max(len(features["origin"]) / time for features, time in zip(batches, times, strict=True))

    def _batches(self, forecaster: Forecaster) -> Iterable[Features]:
        """Yield the features of one, two, four … requests, up to a large batch."""
        parts = []
        for request in self._requests:
            scene = scene_of(request.message, forecaster.info.history_frames)
            parts.append(forecaster.prepare(scene, np.arange(len(scene.types))))
        agents, count = len(self._requests[0].message.agents), 1
        while True:
            yield join([parts[index % len(parts)] for index in range(count)])
            if count * agents >= _MIN_RAW_AGENTS:
                return
            count *= 2


def scene_of(message: PredictRequest, frames: int) -> Scene:
    """Return the scene that a made-up request describes.

    Args:
        message: the request, whose vehicles have equally many states.
        frames: max number of history frames.
    """
    values = np.array(
        [
            [
                (state.time, state.x, state.y, state.heading, state.velocity_x, state.velocity_y)
                for state in agent.states
            ]
            for agent in message.agents
        ]
    )
    agents, states = values.shape[:2]
    observations = Observations(
        count=np.full(agents, states),
        time=values[..., 0],
        position=values[..., 1:3],
        heading=values[..., 3],
        velocity=values[..., 4:6],
        acceleration=np.full((agents, states, 2), np.nan),
        heading_rate=np.full((agents, states), np.nan),
    )
    given = message.scene_raster
    bits = np.unpackbits(np.frombuffer(given.image.packed_bits, dtype=np.uint8))
    layers = bits[: 3 * given.rows * given.columns].reshape(3, given.rows, given.columns)
    raster = Raster(layers, np.array([given.origin_x, given.origin_y]), given.pixels_per_meter)
    return Scene([AgentType.VEHICLE] * agents, resample(observations, message.time, frames), raster)


def difference(
    ids: Sequence[str], weights: Floats, means: Floats, covariances: Floats, mixture: TrajectoryMixture
) -> str:
    """Return how forecasts differ from a mixture by more than an answer may; empty: they do not.

    Args:
        ids: names of the N agents.
        weights: [N, K].
        means: [N, K, T, 2], m, in the ground frame.
        covariances: [N, K, T, 2, 2], m²; only the variances are compared.
        mixture: the mixture that is expected.
    """
    expected_weights: Floats = mixture.log_weights.double().softmax(dim=1).numpy()
    variances = (0, 1), (0, 1)
    expected_sigma = np.sqrt(mixture.covariances.double().numpy()[..., *variances])
    sigma = np.sqrt(np.maximum(covariances[..., *variances], 0))
    weight_errors = np.abs(weights - expected_weights).max(axis=1)
    position_errors = np.abs(means - mixture.world_means.numpy()).max(axis=(1, 2, 3))
    sigma_errors = np.abs(sigma - expected_sigma).max(axis=(1, 2, 3))
    # Written so that a NaN is a fault too
    right = (
        (weight_errors <= MAX_WEIGHT_ERROR)
        & (position_errors <= MAX_POSITION_ERROR)
        & (sigma_errors <= MAX_POSITION_ERROR)
    )
    if right.all():
        return ""
    row = int(np.argmin(right))
    return (
        f"{ids[row]}: off by {position_errors[row]:.2g} m, in weights by {weight_errors[row]:.2g}, "
        f"in σ by {sigma_errors[row]:.2g} m"
    )


def _difference(answer: PredictResponse, mixture: TrajectoryMixture) -> str:
    agents, modes, steps = mixture.means.shape[:3]
    weights = np.empty((agents, modes))
    means = np.empty((agents, modes, steps, 2))
    covariances = np.empty((agents, modes, steps, 3))
    for row, forecast in enumerate(answer.forecasts):
        try:
            weights[row] = np.array(forecast.weights).reshape(modes)
            means[row] = np.array(forecast.means).reshape(modes, steps, 2)
            covariances[row] = np.array(forecast.covariances).reshape(modes, steps, 3)
        except ValueError:
            return f"{forecast.agent_id}: there are too few or too many numbers"
    symmetric = covariances[..., [0, 1, 1, 2]].reshape(agents, modes, steps, 2, 2)
    ids = [forecast.agent_id for forecast in answer.forecasts]
    return difference(ids, weights, means, symmetric, mixture)
