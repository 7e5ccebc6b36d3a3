"""The demo request: a moment of the simulated junction."""

import math
import subprocess
import sys

import numpy as np
import pytest
from google.protobuf import json_format

from cab.forecast.v1.prediction_service_pb2 import Agent, PredictRequest
from cab_forecast import demo_request
from cab_forecast.forecast import type_name
from cab_forecast.layers import decode_layers

AGENTS = list(demo_request().agents)
by_agent = pytest.mark.parametrize("agent", AGENTS, ids=lambda agent: agent.id)


def test_is_the_same_at_every_call() -> None:
    assert demo_request().SerializeToString(deterministic=True) == demo_request().SerializeToString(
        deterministic=True
    )


def test_has_all_kinds_of_road_users_and_one_that_was_just_seen() -> None:
    assert {type_name(agent.type) for agent in AGENTS} == {"vehicle", "pedestrian", "cyclist"}
    assert 10 <= len({agent.id for agent in AGENTS}) == len(AGENTS) <= 16
    assert max(len(agent.states) for agent in AGENTS) == 21


def test_can_be_moved_in_time() -> None:
    request = demo_request(50.0)
    assert request.time == 50.0
    assert {agent.states[-1].time for agent in request.agents} == {50.0}


def test_layers() -> None:
    raster = demo_request().scene_raster
    layers = decode_layers(raster.image, raster.rows, raster.columns)
    assert layers.any(axis=(1, 2)).all()
    assert (layers[1:] <= layers[0]).all()  # paint is on roads

    def at(x: float, y: float) -> list[bool]:
        found: list[bool] = layers[
            :, round((x - raster.origin_x) * 3), round((y - raster.origin_y) * 3)
        ].tolist()
        return found

    assert at(0, 0) == [True, False, False]
    assert at(30, 0) == [True, True, False]
    assert at(30, 3.5) == [True, False, True]
    assert at(38, -10) == [True, False, False]  # the lay-by
    assert at(30, 10) == [False] * 3
    assert at(14, 14) == [False] * 3
    assert at(9.5, 9.5)[0]  # a rounded corner


@by_agent
def test_times_ascend_to_now_and_all_is_finite(agent: Agent) -> None:
    times = np.array([state.time for state in agent.states])
    np.testing.assert_allclose(np.diff(times), 0.1, atol=1e-6)
    assert times[-1] == demo_request().time
    assert all(math.isfinite(value) for state in agent.states for _, value in state.ListFields())


@by_agent
def test_headings_and_velocities_agree_with_the_motion(agent: Agent) -> None:
    xy = np.array([(state.x, state.y) for state in agent.states])
    headings = np.array([state.heading for state in agent.states])
    velocities = np.array([(state.velocity_x, state.velocity_y) for state in agent.states])
    moved = np.diff(xy, axis=0) / 0.1
    np.testing.assert_allclose(moved, (velocities[1:] + velocities[:-1]) / 2, atol=0.1)
    directions = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    np.testing.assert_allclose(velocities, np.hypot(*velocities.T)[:, None] * directions, atol=1e-9)


def test_prints_itself() -> None:
    run = subprocess.run([sys.executable, "-m", "cab_forecast.demo"], check=True, capture_output=True)
    assert json_format.Parse(run.stdout, PredictRequest()) == demo_request()
