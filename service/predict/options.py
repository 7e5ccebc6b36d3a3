"""The parts of a request that concern the call as a whole."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab.forecast.v1.bounds import FIELD_BOUNDS, MAX_ID_LENGTH, STEP_SECONDS
from model.forecaster import Context, ModelInfo
from model.scenes.scene import Raster
from service.errors import BadField, TooLarge, id_too_long
from service.predict.images import decode_layers
from service.settings import Settings

_CONTEXTS = {
    pb.CONTEXT_UNSPECIFIED: Context.FULL,
    pb.CONTEXT_FULL: Context.FULL,
    pb.CONTEXT_BLIND: Context.BLIND,
}
_RasterNumber = Literal["origin_x", "origin_y", "pixels_per_meter"]
_RASTER_NUMBERS: tuple[_RasterNumber, ...] = get_args(_RasterNumber)
_RECALLS = {
    pb.HISTORY_SOURCE_UNSPECIFIED: False,
    pb.HISTORY_SOURCE_REQUEST: False,
    pb.HISTORY_SOURCE_MEMORY: True,
}


@dataclass(frozen=True)
class Options:
    """How a call wants to be answered."""

    time: float
    """The present, s."""
    steps: int
    context: Context
    max_modes: int
    """0: all."""
    merge: bool
    """Whether modes that a planner would not tell apart are returned as one."""
    samples: int
    seed: int | None
    strict: bool
    predicted: int
    """Agents that want a forecast."""
    scene_id: str
    """Empty: the call is not tracked."""
    recalls: bool
    """Whether histories come from the track memory as well."""
    consistency: bool
    """Whether each agent's latest consistency is wanted."""


def read_options(request: pb.PredictRequest, info: ModelInfo, settings: Settings) -> Options:
    """Checks everything but agents and map.

    Args:
        request: the request.
        info: the model that it asks for.
        settings: the limits.

    Raises:
        BadField: a field is missing or out of its range.
        TooLarge: too many agents.
    """
    if len(request.agents) > settings.max_agents:
        raise TooLarge(f"{len(request.agents)} agents; at most {settings.max_agents} are accepted")
    if len(request.scene_id) > MAX_ID_LENGTH:
        raise BadField("scene_id", id_too_long(request.scene_id))
    if not request.HasField("time"):
        raise BadField("time", "is required")
    _check_number("time", request.time, *FIELD_BOUNDS["PredictRequest.time"])

    options = request.options
    context = _CONTEXTS.get(options.context)
    if context is None:
        raise BadField("options.context", f"unknown value {options.context}")
    if context is Context.BLIND and not info.supports_blind:
        raise BadField("options.context", f"{info.name} has no blind forecast")
    if options.history not in _RECALLS:
        raise BadField("options.history", f"unknown value {options.history}")
    recalls = _RECALLS[options.history]
    for name, asked in (("history", recalls), ("consistency", options.consistency)):
        if asked and not request.scene_id:
            raise BadField(f"options.{name}", "needs a scene_id")
    predicted = sum(not agent.HasField("predict") or agent.predict for agent in request.agents)
    if options.samples > settings.max_samples:
        raise BadField("options.samples", f"at most {settings.max_samples}")
    if options.samples * predicted > settings.max_samples_per_call:
        raise BadField(
            "options.samples",
            f"{options.samples} × {predicted} agents; at most {settings.max_samples_per_call} in a call",
        )
    return Options(
        time=request.time,
        steps=_steps(options, info),
        context=context,
        max_modes=options.max_modes,
        merge=options.merge,
        samples=options.samples,
        seed=options.seed if options.HasField("seed") else None,
        strict=options.strict,
        predicted=predicted,
        scene_id=request.scene_id,
        recalls=recalls,
        consistency=options.consistency,
    )


def read_raster(request: pb.PredictRequest, settings: Settings) -> Raster | None:
    """The map of the whole scene, if there is one.

    Raises:
        BadField: a part of it is missing, out of its range, or does not fit the rest.
    """
    if not request.HasField("scene_raster"):
        return None
    raster = request.scene_raster
    for number in _RASTER_NUMBERS:
        if not raster.HasField(number):
            raise BadField(f"scene_raster.{number}", "is required")
        _check_number(
            f"scene_raster.{number}", getattr(raster, number), *FIELD_BOUNDS[f"SceneRaster.{number}"]
        )
    if raster.image.WhichOneof("encoding") == "packed_bits":
        for name, size in (("rows", raster.rows), ("columns", raster.columns)):
            if size == 0:
                raise BadField(f"scene_raster.{name}", "is required with packed_bits")
    if raster.rows * raster.columns > settings.max_raster_pixels:
        raise BadField(
            "scene_raster.rows",
            f"{raster.rows} × {raster.columns} pixels; at most {settings.max_raster_pixels} are accepted",
        )
    layers = decode_layers(
        raster.image,
        "scene_raster.image",
        raster.rows or None,
        raster.columns or None,
        settings.max_raster_pixels,
    )
    origin = np.array([raster.origin_x, raster.origin_y])
    return Raster(layers=layers, origin=origin, pixels_per_meter=raster.pixels_per_meter)


def _steps(options: pb.PredictOptions, info: ModelInfo) -> int:
    if not options.HasField("horizon"):
        return info.steps
    _check_number("options.horizon", options.horizon, STEP_SECONDS, info.horizon)
    steps = round(options.horizon / STEP_SECONDS)
    if abs(steps * STEP_SECONDS - options.horizon) > 1e-6:
        raise BadField("options.horizon", f"must be a multiple of {STEP_SECONDS} s")
    return steps


def _check_number(field: str, value: float, low: float, high: float) -> None:
    if not math.isfinite(value):
        raise BadField(field, "must be a finite number")
    if not low <= value <= high:
        raise BadField(field, f"must be within {low:g} … {high:g}")
