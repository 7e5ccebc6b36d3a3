"""The cases of the folder shared/, which are given from outside the project."""

import math
from pathlib import Path

import numpy as np
from google.protobuf import json_format

from cab.forecast.v1 import prediction_service_pb2 as pb
from cab_forecast.layers import decode_layers
from model.scenes.scene import Raster
from tests.cases.case import CAR, Case, Facts, Frame, Row

_CLEAN = "straight_10_clean"
_OUTER = (0.0, -5.25)
_WAITING = (-13.0, -1.75)
KNOWN: dict[str, tuple[Row, tuple[float, float], Facts]] = {
    "standing_v0": (Row.STANDING, _WAITING, Facts(0.0)),
    "stopped_redlight": (Row.STANDING, _WAITING, Facts(0.0)),
    "standing_sideways_2cms": (Row.SIDEWAYS, _WAITING, Facts(0.0)),
    "stopped_redlight_noise3cm": (Row.STANDING, _WAITING, Facts(0.0, noisy=True)),
    "stopped_noheading": (Row.STANDING, _WAITING, Facts(0.0, oriented=False)),
    "parked_kerb": (Row.PARKED, (0.0, -6.2), Facts(0.0)),
    "creeping_0.5": (Row.CREEPING, _OUTER, Facts(0.5)),
    "heading_flip_last": (Row.FLIP, _OUTER, Facts(10.0)),
    "reverse_2": (Row.REVERSE, _OUTER, Facts(-2.0)),
    "reverse_2_noheading": (Row.REVERSE, _OUTER, Facts(-2.0, oriented=False)),
    "straight_10_clean": (Row.STRAIGHT, _OUTER, Facts(10.0)),
    "straight_10_noise5cm": (Row.STRAIGHT, _OUTER, Facts(10.0, noisy=True, companion=_CLEAN)),
    "straight_10_noise5cm_h": (Row.STRAIGHT, _OUTER, Facts(10.0, noisy=True, companion=_CLEAN)),
    "straight_10_nomap": (Row.STRAIGHT, _OUTER, Facts(10.0)),
    "straight_2hz": (Row.STRAIGHT, _OUTER, Facts(10.0)),
    "jitter_30ms": (Row.STRAIGHT, _OUTER, Facts(10.0)),
    "timestamp_err_30ms": (Row.STRAIGHT, _OUTER, Facts(10.0, noisy=True)),
    "noisy_headings_0.1": (Row.NOISY_HEADINGS, _OUTER, Facts(10.0)),
    "highway_25": (Row.HIGHWAY, (0.0, -5.75), Facts(25.0)),
    "highway_33": (Row.HIGHWAY, (0.0, -5.75), Facts(33.0)),
    "accelerating_2": (Row.ACCELERATING, _OUTER, Facts(3.0, acceleration=2.0)),
    "braking_3": (Row.BRAKING, _OUTER, Facts(5.5, acceleration=-3.0)),
    "curve_R55_entry": (Row.CURVE, _OUTER, Facts(10.0)),
    "junction_8_at_25m": (Row.JUNCTION, (-25.0, -1.75), Facts(8.0)),
    "left_turn_after1s": (Row.LEFT_TURN, (-1.4283, 0.1585), Facts(6.0, turned=0.6667)),
    "lead_stands": (Row.LEAD, (0.0, -1.75), Facts(10.0)),
    "one_state": (Row.SHORT, _OUTER, Facts(10.0, companion=_CLEAN)),
    "one_state_noheading": (Row.SHORT, _OUTER, Facts(10.0, companion=_CLEAN)),
    "two_states_0.1": (Row.SHORT, _OUTER, Facts(10.0, companion=_CLEAN)),
    "two_states_0.5": (Row.SHORT, _OUTER, Facts(10.0, companion=_CLEAN)),
}
"""The row, true position and true state of the car, by file name; the true heading is ``turned``."""


def read_cases(folder: Path) -> list[Case]:
    """Return the cases of a folder, in the order of the table.

    Raises:
        FileNotFoundError: a known case is missing.
        ValueError: the folder holds an unknown case.
    """
    unknown = {file.stem for file in folder.glob("*.json")} - set(KNOWN)
    if unknown:
        raise ValueError(f"{folder}: no row is known for {', '.join(sorted(unknown))}")
    return [_read(folder / f"{name}.json") for name in KNOWN]


def _read(file: Path) -> Case:
    row, position, facts = KNOWN[file.stem]
    request = json_format.Parse(file.read_text(), pb.PredictRequest())
    frame = Frame(np.array(position), facts.turned)
    leads = [agent.states[-1] for agent in request.agents if agent.id != CAR]
    lead = None
    if leads:
        there = frame.to_local(np.array([leads[0].x, leads[0].y]))
        lead = Frame(there, math.remainder(leads[0].heading - frame.heading, 2 * math.pi))
    return Case(file.stem, row, request, frame, facts, _raster(request), lead)


def _raster(request: pb.PredictRequest) -> Raster | None:
    if not request.HasField("scene_raster"):
        return None
    sent = request.scene_raster
    layers = decode_layers(sent.image, sent.rows, sent.columns).astype(np.uint8)
    return Raster(layers, np.array([sent.origin_x, sent.origin_y]), sent.pixels_per_meter)
