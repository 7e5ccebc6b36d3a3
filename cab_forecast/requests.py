"""Builders of requests, from numpy arrays and plain Python.

The builders check shapes, which are lost in a message. Values are checked by the server, so that all clients
follow the same rules.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from cab.forecast.v1.bounds import PATCH_PIXELS
from cab.forecast.v1.model_service_pb2 import AgentType
from cab.forecast.v1.prediction_service_pb2 import (
    CONTEXT_BLIND,
    CONTEXT_FULL,
    HISTORY_SOURCE_MEMORY,
    HISTORY_SOURCE_UNSPECIFIED,
    Agent,
    AgentState,
    MapPatch,
    PredictOptions,
    PredictRequest,
    SceneRaster,
)
from cab_forecast.layers import ImageEncoding, as_layers, encode_layers

TypeName = Literal["vehicle", "pedestrian", "cyclist", "unknown"]
Context = Literal["full", "blind"]
History = Literal["request", "memory"]

PIXELS_PER_METER = 3.0
"""Resolution of a near patch. A raster of the same resolution loses no detail when the server crops it."""

_Floats = npt.NDArray[np.float64]


def agent(
    agent_id: str,
    agent_type: TypeName,
    times: npt.ArrayLike,
    positions: npt.ArrayLike,
    *,
    headings: npt.ArrayLike | None = None,
    velocities: npt.ArrayLike | None = None,
    accelerations: npt.ArrayLike | None = None,
    heading_rates: npt.ArrayLike | None = None,
    predict: bool = True,
    map_patch: MapPatch | None = None,
    far_map_patch: MapPatch | None = None,
    patch: MapPatch | None = None,
) -> Agent:
    """Build an agent with its history of F observations, oldest first.

    In the optional arrays NaN means that the value was not observed at that time.

    Args:
        agent_id: unique within the request.
        agent_type: what kind of road user it is.
        times: [F], seconds since the epoch, ascending.
        positions: [F, 2], m, ground frame.
        headings: [F], rad counter-clockwise from the ground frame's x axis.
        velocities: [F, 2], m/s, ground frame.
        accelerations: [F, 2], m/s², ground frame.
        heading_rates: [F], rad/s.
        predict: whether to forecast the agent; False: it is only a neighbour of the others.
        map_patch: its own map, see ``map_patch``; takes precedence over the scene's raster.
        far_map_patch: its own map at a larger scale; only some models use it.
        patch: alias of ``map_patch``.

    Raises:
        ValueError: the type is unknown, shapes do not match, or both ``map_patch`` and ``patch`` are given.
    """
    if patch is not None:
        if map_patch is not None:
            raise ValueError(f"agent {agent_id!r}: give either map_patch or its alias patch, not both")
        map_patch = patch
    stamps = np.atleast_1d(np.asarray(times, dtype=np.float64))
    if stamps.ndim != 1:
        raise ValueError(f"agent {agent_id!r}: times must be [F], but are {list(stamps.shape)}")
    count = len(stamps)
    columns: dict[str, _Floats] = {"time": stamps}
    for name, values, fields in (
        ("positions", positions, ("x", "y")),
        ("headings", headings, ("heading",)),
        ("velocities", velocities, ("velocity_x", "velocity_y")),
        ("accelerations", accelerations, ("acceleration_x", "acceleration_y")),
        ("heading_rates", heading_rates, ("heading_rate",)),
    ):
        if values is not None:
            columns |= _columns(f"agent {agent_id!r}: {name}", values, count, fields)
    required = ("time", "x", "y")
    states = [
        AgentState(**{k: v for k, v in zip(columns, row, strict=True) if k in required or not math.isnan(v)})
        for row in zip(*(column.tolist() for column in columns.values()), strict=True)
    ]
    return Agent(
        id=agent_id,
        type=_type_number(agent_type),
        states=states,
        predict=predict,
        map_patch=map_patch,
        far_map_patch=far_map_patch,
    )


def scene_raster(
    layers: npt.ArrayLike,
    origin: Sequence[float],
    pixels_per_meter: float = PIXELS_PER_METER,
    encoding: ImageEncoding = "packed_bits",
) -> SceneRaster:
    """Build the map of a whole scene, from which the server crops a patch for each agent.

    Args:
        layers: [3, rows, columns], binary: driveable area, road dividers, lane dividers. Element
            [layer, i, j] shows the ground point ``origin + (i, j) / pixels_per_meter``: rows run along x.
        origin: ground position of element [·, 0, 0], m.
        pixels_per_meter: resolution.
        encoding: ``packed_bits``, or ``png``, which is smaller and slower.

    Raises:
        ValueError: the layers are not binary or not [3, rows, columns], or the encoding is unknown.
    """
    array = as_layers(layers)
    origin_x, origin_y = origin
    return SceneRaster(
        image=encode_layers(array, encoding),
        rows=array.shape[1],
        columns=array.shape[2],
        origin_x=origin_x,
        origin_y=origin_y,
        pixels_per_meter=pixels_per_meter,
    )


def map_patch(layers: npt.ArrayLike, encoding: ImageEncoding = "packed_bits") -> MapPatch:
    """Build the map in one agent's frame, near or far.

    Args:
        layers: [3, 100, 100], binary: driveable area, road dividers, lane dividers. Element [layer, i, j]
            shows the point (i − 10)/3 m ahead of the agent and (j − 50)/3 m to its left; of a far patch the
            point (i − 14)/1.4 m ahead and (j − 50)/1.4 m to the left.
        encoding: see ``scene_raster``.

    Raises:
        ValueError: the layers are not binary or not [3, 100, 100], or the encoding is unknown.
    """
    array = as_layers(layers)
    if array.shape[1:] != (PATCH_PIXELS, PATCH_PIXELS):
        raise ValueError(f"a patch must be [3, {PATCH_PIXELS}, {PATCH_PIXELS}], but is {list(array.shape)}")
    return MapPatch(image=encode_layers(array, encoding))


def predict_request(
    time: float,
    agents: Iterable[Agent],
    *,
    scene_id: str = "",
    model: str = "",
    raster: SceneRaster | None = None,
    max_modes: int = 0,
    merge: bool = True,
    samples: int = 0,
    seed: int | None = None,
    horizon: float | None = None,
    context: Context | None = None,
    strict: bool = False,
    history: History = "request",
    consistency: bool = False,
    priority: int = 0,
    blind: bool | None = None,
) -> PredictRequest:
    """Build a request for one scene at one time.

    Args:
        time: the present, seconds since the epoch.
        agents: the agents, see ``agent``.
        scene_id: name of the scene; if given, the server keeps tracks of its agents and evaluates the
            forecasts with later observations.
        model: ``name`` or ``name@version``; empty: the server's default.
        raster: map of the scene, see ``scene_raster``.
        max_modes: max number of modes per agent, the most likely ones; 0: all.
        merge: whether nearly equal modes are merged and their weights summed; False: the model's own modes.
        samples: number of trajectories to sample per agent.
        seed: seed of the samples; None: the server draws one and returns it.
        horizon: seconds, a multiple of 0.5; None: the model's.
        context: ``full``, or ``blind``: each agent is forecast from its own history alone, without map and
            neighbours; None: ``full``.
        strict: whether one invalid agent fails the whole call.
        history: source of earlier observations: ``request``, or ``memory``: the server's tracks as well, so
            that the request only needs new observations. ``memory`` needs a scene_id.
        consistency: whether to return the latest consistency of each agent. Needs a scene_id.
        priority: 0 to 7; under overload calls of a higher priority are forecast first and refused last.
        blind: alias: True is ``context="blind"``, False ``context="full"``.

    Raises:
        ValueError: a count or seed is negative or exceeds 32 bits, context or history is unknown, or both
            ``context`` and ``blind`` are given.
    """
    if history not in get_args(History):
        raise ValueError(f"history must be one of {', '.join(get_args(History))}, not {history!r}")
    if blind is not None:
        if context is not None:
            raise ValueError("give either context or its alias blind, not both")
        context = "blind" if blind else "full"
    if context not in (None, *get_args(Context)):
        raise ValueError(f"context must be one of {', '.join(get_args(Context))}, not {context!r}")
    return PredictRequest(
        time=time,
        agents=agents,
        scene_id=scene_id,
        model=model,
        scene_raster=raster,
        options=PredictOptions(
            max_modes=max_modes,
            merge=merge,
            samples=samples,
            seed=seed,
            horizon=horizon,
            context=CONTEXT_BLIND if context == "blind" else CONTEXT_FULL,
            strict=strict,
            # Left out if it is the default, for servers that do not know the field.
            history=HISTORY_SOURCE_MEMORY if history == "memory" else HISTORY_SOURCE_UNSPECIFIED,
            consistency=consistency,
            priority=priority,
        ),
    )


def _columns(name: str, values: npt.ArrayLike, count: int, fields: Sequence[str]) -> dict[str, _Floats]:
    array = np.asarray(values, dtype=np.float64)
    shape = (count,) if len(fields) == 1 else (count, len(fields))
    if array.shape != shape:
        raise ValueError(f"{name} must be {list(shape)}, but are {list(array.shape)}")
    return dict(zip(fields, array.reshape(count, len(fields)).T, strict=True))


def _type_number(name: TypeName) -> AgentType.ValueType:
    if name not in get_args(TypeName):
        raise ValueError(f"agent type must be one of {', '.join(get_args(TypeName))}, not {name!r}")
    return AgentType.Value(f"AGENT_TYPE_{name.upper()}")
