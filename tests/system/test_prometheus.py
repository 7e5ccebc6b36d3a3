"""Prometheus scrapes every replica, and every panel of the dashboard has data."""

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cab_forecast import AsyncClient, scene_raster
from tests.deploy.files import job_name
from tests.deploy.test_dashboard import PANELS
from tests.model.checkpoints import copy_bundled
from tests.service.requests import make_request
from tests.service.tracks import made_up
from tests.system.fleet import Fleet, fleet, until
from tests.system.prometheus import prometheus

pytestmark = pytest.mark.system
_MODEL = "trajectron-no-context"
_TOKEN = "of-the-test"  # noqa: S105
_VARIABLES = {"$job": job_name(), "$model": ".*", "$__rate_interval": "1m", "$window": "1m"}


def query_of(target: dict[str, Any]) -> str:
    """Return the PromQL of a target with values for Grafana's variables."""
    query: str = target["expr"]
    for name, value in _VARIABLES.items():
        query = query.replace(name, value)
    return query


async def traffic(made: Fleet) -> None:
    """Send calls that move every series: tracks that settle, maps, and a failure of the track memory."""
    tracks = made_up("scene", agents=2)
    off_road = make_request(1)
    off_road.scene_raster.CopyFrom(scene_raster(np.zeros((3, 300, 300), dtype=np.uint8), (-50.0, -50.0)))
    for endpoint in (made.grpc, made.rest):
        async with AsyncClient(endpoint, token=_TOKEN, timeout=30) as client:
            for frame in tracks.frames():
                await client.predict(tracks.request(frame, _MODEL))
            await client.predict(off_road)
            await client.predict(off_road)
    made.redis.pause()
    try:
        async with AsyncClient(made.grpc, token=_TOKEN, timeout=30) as client:
            await client.predict(tracks.request(tracks.frames()[-1], _MODEL))
    finally:
        made.redis.resume()


async def test_every_panel_of_the_dashboard_has_data(tmp_path: Path) -> None:
    copy_bundled(tmp_path / "models" / _MODEL, _MODEL)
    settings = {
        "api_tokens": _TOKEN,
        "default_model": _MODEL,
        "record": tmp_path / "record",
        "shadow": "kalman@1.0.0:1.0",
    }
    async with fleet(tmp_path, **settings) as made:
        balancer = re.sub(r"http://|/metrics", "", made.metrics)
        servers = [each.http for each in made.replicas]
        async with prometheus(tmp_path, _TOKEN, servers, balancer) as scraping:
            ask = scraping.ask
            await until(lambda: len(ask(f'up{{job="{job_name()}"}} == 1')) == 2, "both replicas are scraped")
            await until(lambda: ask('up{job="haproxy"} == 1'), "HAProxy is scraped")
            await traffic(made)
            for query in [query_of(target) for panel in PANELS for target in panel["targets"]]:
                # Rates have data after two more scrapes
                await until(partial(ask, query), f"no data: {query}")
