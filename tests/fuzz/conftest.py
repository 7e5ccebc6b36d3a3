"""Server with every kind of model, in its own thread, for generated requests."""

import asyncio
import threading
from collections.abc import Iterator

import pytest

from loadtest.forward import cab_network
from model.baselines import kalman, physics
from model.registry import Registry
from service.server import Server
from tests.service.servers import settings


@pytest.fixture(scope="session")
def server() -> Iterator[Server]:
    """Run a server with physics, Kalman and, as the default, a CAB network with seeded random weights."""
    started = threading.Event()
    loop = asyncio.new_event_loop()
    box: list[Server] = []

    async def start() -> None:
        # Limits small enough for generated requests to reach
        limits = {"max_agents": 4, "max_states": 6, "max_raster_pixels": 3000, "default_model": "cab"}
        box.append(Server(settings(**limits), load=lambda _: registry()))
        await box[0].start()
        started.set()

    def serve() -> None:
        asyncio.set_event_loop(loop)
        loop.run_until_complete(start())
        loop.run_forever()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    assert started.wait(60), "the server did not start"
    yield box[0]
    asyncio.run_coroutine_threadsafe(box[0].stop(), loop).result(30)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(10)
    loop.close()


def registry() -> Registry:
    """Return a registry with every kind of model."""
    return Registry([*physics.baselines(), kalman.Kalman(), cab_network()])


@pytest.fixture(scope="session")
def model_names() -> list[str]:
    """Return the names of the models; an empty name is the default."""
    return ["", "", *[info.name for info in registry().infos()], "cab"]
