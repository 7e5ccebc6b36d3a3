"""All vehicles of a real frame, by the published Trajectron++ weights, over both transports."""

from pathlib import Path

import numpy as np
import pytest

from cab.forecast.v1 import model_service_pb2 as models
from cab_forecast import AsyncClient, Status, forecasts
from model.convert import convert_trajectron
from service.server import Server
from tests.nuscenes_pred import real_request
from tests.service.servers import settings

SCENE = "scene-0234"
"""Scene of train_val with the most vehicles in a frame."""


@pytest.fixture(scope="module")
def checkpoints(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the published weights."""
    folder = tmp_path_factory.mktemp("models")
    convert_trajectron(shared / "reference/weights/trajectron_int_ee_me", 12, folder / "trajectron")
    return folder


@pytest.mark.parametrize("default", ["trajectron", "kalman"])
async def test_every_vehicle_of_a_frame_in_one_call(shared: Path, checkpoints: Path, default: str) -> None:
    request = real_request(shared / "data/nuscenes_pred", "val", SCENE)
    assert len(request.agents) >= 15
    request.ClearField("scene_id")  # or the second answer would be of a scene that the first call made known
    server = Server(settings(models=checkpoints, default_model=default, allow_paper_protocol=True))
    await server.start()
    answers = []
    try:
        rest = f"http://{server.http_address}"
        for client in (
            AsyncClient(f"grpc://{server.grpc_address}"),
            AsyncClient(rest),
            AsyncClient(rest, encoding="json"),
        ):
            async with client:
                answers.append(await client.predict(request))
    finally:
        await server.stop()

    for answer in answers:
        answer.ClearField("timing")
    assert answers[0] == answers[1] == answers[2]  # equal to the last bit
    answer = answers[0]
    assert answer.model.name == default
    assert bool(answer.warnings) == (answer.model.protocol == models.INPUT_PROTOCOL_PAPER)
    by_id = forecasts(answer)
    assert list(by_id) == [agent.id for agent in request.agents]
    for agent in request.agents:
        forecast = by_id[agent.id]
        frames = 9 if default == "trajectron" else 5
        enough = len(agent.states) >= frames
        assert forecast.status is (Status.OK if enough else Status.SHORT_HISTORY), forecast
        # Nobody jumps: half a second ahead is near where constant velocity says
        now, before = agent.states[-1], agent.states[-2]
        expected = np.array([2 * now.x - before.x, 2 * now.y - before.y])
        assert np.linalg.norm(forecast.most_likely[0] - expected) < 1.5
