"""Every alert of deploy/prometheus/alerts.yml is provoked on running servers and seen firing.

The rules are those of the repository, with shorter ranges and without waiting: what takes an hour there takes
seconds here. Thresholds are the same.
"""

import asyncio
import os
import resource
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import ExitStack, asynccontextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from cab_forecast import AsyncClient, ForecastError, scene_raster
from loadtest.redis_servers import Process, single
from loadtest.servers import Server, serving
from service.access.key_file import new_key, write_keys
from service.access.scopes import Scope
from tests.deploy.files import job_name, rules
from tests.model.checkpoints import copy_bundled
from tests.service.fakes import FakeForecaster
from tests.service.requests import make_request
from tests.service.servers import running
from tests.service.tracks import Track, Tracks
from tests.system.fleet import free_port, until
from tests.system.prometheus import Prometheus, faster, prometheus

pytestmark = pytest.mark.system
_ALERTS = {rule["alert"] for rule in rules("alerts.yml") if "alert" in rule}
_MODEL = "trajectron-no-context"
_SECONDS = 45.0
_SETTLED = 14
"""Frames at 2 Hz after which the first forecasts of an agent are compared with what it did."""
_RANGES = {
    "[1h]": "[12s]",
    "[1d] offset 1h": "[60s] offset 12s",
    "[15m]": "[8s]",
    "[5m]": "[8s]",
}

Attempt = Callable[[], Awaitable[object]]


class Watch:
    """What has fired so far."""

    def __init__(self, scraping: Prometheus) -> None:
        self.scraping = scraping
        self.seen: set[str] = set()

    async def until(self, names: Sequence[str], attempt: Attempt) -> None:
        """Try again and again until these alerts have been seen firing.

        Args:
            names: the alerts.
            attempt: does what should raise them; calls of it may fail.
        """
        async with asyncio.timeout(_SECONDS):
            while not self.seen.issuperset(names):
                with suppress(ForecastError):
                    await attempt()
                self.seen |= await asyncio.to_thread(self.scraping.firing)
                await asyncio.sleep(0.05)


def drives(name: str, agents: int, frames: int, *, straight: bool) -> Tracks:
    """Return a scene of vehicles at 12 m/s that go straight on, or turn off every other second."""
    random = np.random.default_rng(len(name))
    turns = random.uniform(1.5, 4.5, (agents, frames // 4 + 1)).cumsum(axis=1).repeat(4, axis=1)[:, :frames]
    course = np.zeros((agents, frames)) if straight else turns
    steps = 6.0 * np.stack([np.cos(course), np.sin(course)], axis=2)
    start = np.arange(agents)[:, None, None] * np.array([0.0, 8.0])
    position = start + steps.cumsum(axis=1)
    return Tracks(name, 1.7e9, 0.5, {f"agent {i}": Track(0, position[i]) for i in range(agents)})


async def drive(client: AsyncClient, tracks: Tracks) -> None:
    """Send all frames of a scene."""
    for frame in tracks.frames():
        await client.predict(tracks.request(frame, _MODEL), timeout=30)


@asynccontextmanager
async def serving_in_thread(stack: ExitStack, models: Path, **settings: object) -> AsyncIterator[Server]:
    """Run a server process without blocking the event loop."""
    yield await asyncio.to_thread(stack.enter_context, serving(models, **settings))  # type: ignore[arg-type]


async def test_every_alert_fires(tmp_path: Path) -> None:
    token, entry = new_key("everyone", tuple(Scope))
    keys, models, record = tmp_path / "keys.json", tmp_path / "models", tmp_path / "record"
    write_keys(keys, [entry])
    copy_bundled(models / _MODEL, _MODEL)
    fake = FakeForecaster()
    with ExitStack() as stack:
        redis = stack.enter_context(single())
        settings = {"keys_file": keys, "default_model": _MODEL, "store": redis.url, "record": record}
        async with (
            serving_in_thread(stack, models, store_budget_ms=20, **settings) as server,
            running(fake, api_tokens=(token,)) as broken,
            prometheus(
                tmp_path, token, [server.http, broken.http_address], change=faster(_RANGES)
            ) as scraping,
            AsyncClient(f"grpc://{server.grpc}", token, retries=0) as client,
            AsyncClient(f"http://{broken.http_address}", token, retries=0) as other,
        ):
            query = f'up{{job="{job_name()}"}} == 1'
            await until(lambda: len(scraping.ask(query)) == 2, "both servers are scraped")
            watch = Watch(scraping)
            await until(lambda: not scraping.firing(), "nothing fires")
            # Of the day before there must be 1000 sets, which the other alerts give time to become old
            await drive(client, drives("good", 60, 60, straight=True))
            await faults_of_a_model(watch, fake, other)
            await faults_of_files(watch, server, client, models, keys, record)
            await drifting(watch, client)
            await faults_of_redis(watch, client, redis)
            await faults_of_servers(watch, server, stack, tmp_path, token)
            assert watch.seen == _ALERTS


async def faults_of_a_model(watch: Watch, fake: FakeForecaster, client: AsyncClient) -> None:
    """Make forwards fail, return NaN and take long, and send what is too large."""
    fake.broken = True
    await watch.until(["ForecastCallsFailing"], lambda: client.predict(make_request()))
    fake.broken, fake.nan_beyond = False, -1.0
    await watch.until(["ForecastsNotFinite"], lambda: client.predict(make_request()))
    fake.nan_beyond = np.inf
    await watch.until(["ForecastOverload"], lambda: client.predict(make_request(2000)))

    async def slowly() -> None:
        fake.free.clear()
        asyncio.get_running_loop().call_later(0.4, fake.free.set)
        await client.predict(make_request(), timeout=20)

    await watch.until(["ForecastSlow"], slowly)


async def faults_of_files(
    watch: Watch, server: Server, client: AsyncClient, models: Path, keys: Path, record: Path
) -> None:
    """Damage a checkpoint and the file of keys, and let the disk of the recording run full."""
    damaged = copy_bundled(models / "damaged", _MODEL, version="9.0.0")
    (damaged / "model.safetensors").write_bytes(b"no tensors")
    await watch.until(["ForecastReloadRefused"], client.reload_models)
    good = exchange(keys, b"{")
    await watch.until(["ForecastAccessFilesBroken"], client.list_models)
    exchange(keys, good)

    random = np.random.default_rng(0)

    async def record_a_map() -> None:
        request = make_request(1)
        layers = random.integers(0, 2, (3, 600, 600), dtype=np.uint8)
        request.scene_raster.CopyFrom(scene_raster(layers, (-50.0, -50.0)))
        await client.predict(request, timeout=20)

    # No file of the process may grow any more, as on a full disk; its log is much smaller than the recording
    while recorded_bytes(record) < 2**20:
        await record_a_map()
    pid = server.process.pid
    former = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (2**20, former[1]))
    await watch.until(["ForecastRecordingIncomplete"], record_a_map)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, former)


def exchange(file: Path, content: bytes) -> bytes:
    """Write a file, and return what it held."""
    former = file.read_bytes()
    file.write_bytes(content)
    return former


def recorded_bytes(folder: Path) -> int:
    """Return the size of a recording."""
    return sum(file.stat().st_size for file in folder.glob("*.mcap"))


async def drifting(watch: Watch, client: AsyncClient) -> None:
    """Send agents that do what no model forecasts, then agents that have new ids in every call."""
    numbers = iter(range(1000))

    async def bad() -> None:
        await drive(client, drives(f"bad {next(numbers)}", 30, _SETTLED + 12, straight=False))

    names = ["ErrorAboveBenchmark", "ErrorRising", "DispersionAboveBenchmark", "ConvergenceCollapsed"]
    await watch.until([f"Forecast{name}" for name in names], bad)

    async def new() -> None:
        for _ in range(10):
            await drive(client, drives(f"new {next(numbers)}", 1, 1, straight=True))

    await watch.until(["ForecastsNotSettling"], new)


async def faults_of_redis(watch: Watch, client: AsyncClient, redis: Process) -> None:
    """Let Redis hang for a moment, again and again."""

    async def hang() -> None:
        redis.pause()
        try:
            for number in range(3):
                await drive(client, drives(f"hangs {number}", 1, 1, straight=True))
        finally:
            redis.resume()
        await asyncio.sleep(1)  # the circuit closes again

    await watch.until(["ForecastTrackStoreFailing", "ForecastTrackStoreSlow"], hang)


async def faults_of_servers(watch: Watch, server: Server, stack: ExitStack, folder: Path, token: str) -> None:
    """Start a server whose models cannot be read, kill the other one, and take all away from Prometheus."""
    models, http = folder / "hanging", f"127.0.0.1:{free_port()}"
    config = models / "any" / "config.json"
    config.parent.mkdir(parents=True)
    os.mkfifo(config)  # reading it hangs, as a file of a file server that is gone
    watch.scraping.scrape([server.http, http])
    starting = asyncio.create_task(
        asyncio.to_thread(
            stack.enter_context, serving(models, http=http, api_tokens=token, default_model="kalman")
        )
    )
    await watch.until(["ForecastServerNotReady"], lambda: asyncio.sleep(0.2))
    # What waits for the file reads its end, and it is gone
    writing = os.open(config, os.O_WRONLY)
    config.unlink()
    os.close(writing)
    await starting
    server.process.kill()
    await watch.until(["ForecastServerDown"], lambda: asyncio.sleep(0.2))
    watch.scraping.scrape([])
    await watch.until(["ForecastServerAbsent"], lambda: asyncio.sleep(0.2))
