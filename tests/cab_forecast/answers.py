"""Responses as a server would send them, from plain kinematics."""

import math

import numpy as np

from cab.forecast.v1.model_service_pb2 import INPUT_PROTOCOL_CAUSAL, ModelReference
from cab.forecast.v1.prediction_service_pb2 import (
    FORECAST_STATUS_INVALID,
    FORECAST_STATUS_OK,
    Agent,
    AgentForecast,
    PredictRequest,
    PredictResponse,
    Timing,
)

STEP = 0.5
WEIGHTS = (0.55, 0.2, 0.15, 0.07, 0.03)
TURN_RATES = (0.0, 0.12, -0.12, 0.3, -0.3)
MODEL = ModelReference(name="fan", version="1.0.0", protocol=INPUT_PROTOCOL_CAUSAL)


def answer(request: PredictRequest) -> PredictResponse:
    """Return a fan of constant turns from the last two observations; agents with one state are INVALID."""
    steps = round((request.options.horizon or 6.0) / STEP)
    return PredictResponse(
        forecasts=[_forecast(agent, steps, request.options.samples) for agent in request.agents],
        model=MODEL,
        time=request.time,
        steps=steps,
        step=STEP,
        timing=Timing(queue=0.0002, inference=0.0031, batch_agents=len(request.agents)),
        warnings=["figures of a fan, not of a model"],
    )


def _forecast(agent: Agent, steps: int, samples: int) -> AgentForecast:
    if len(agent.states) < 2:
        return AgentForecast(
            agent_id=agent.id,
            status=FORECAST_STATUS_INVALID,
            field="agents[0].states",
            detail="one state is too few",
        )
    before, now = agent.states[-2:]
    velocity = np.array([now.x - before.x, now.y - before.y]) / (now.time - before.time)
    speed, heading = float(np.hypot(*velocity)), math.atan2(velocity[1], velocity[0])
    times = STEP * np.arange(1, steps + 1)
    means, covariances = [], []
    for rate in TURN_RATES:
        angles = heading + rate * times
        moves = speed * STEP * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        means.append(np.array([now.x, now.y]) + moves.cumsum(axis=0))
        along, across = (0.1 + 0.08 * speed * times) ** 2, (0.1 + 0.03 * speed * times) ** 2
        cos, sin = np.cos(angles), np.sin(angles)
        covariances.append(
            np.stack(
                [
                    along * cos**2 + across * sin**2,
                    (along - across) * cos * sin,
                    along * sin**2 + across * cos**2,
                ],
                axis=-1,
            )
        )
    return AgentForecast(
        agent_id=agent.id,
        status=FORECAST_STATUS_OK,
        model=MODEL,
        history_frames=5,
        mode_ids=range(len(WEIGHTS)),
        weights=WEIGHTS,
        means=np.array(means).ravel(),
        covariances=np.array(covariances).ravel(),
        most_likely_mode=0,
        samples=np.tile(means[0], (samples, 1, 1)).ravel(),
    )
