"""The root of REST and the files of the console."""

import re
from collections.abc import AsyncIterator
from importlib import resources
from typing import Any

import httpx
import pytest

from service.server import Server
from service.settings import Settings
from service.transports.rest.console import console_is_on
from tests.service.fakes import FakeForecaster
from tests.service.servers import from_problem, running

BROWSER = {"accept": "text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8"}


@pytest.fixture
async def client() -> AsyncIterator[httpx.AsyncClient]:
    """Return a client without a key of a server that wants one."""
    async with running(FakeForecaster(), api_tokens=("token",)) as server, client_of(server) as made:
        yield made


def client_of(server: Server) -> httpx.AsyncClient:
    return httpx.AsyncClient(base_url=f"http://{server.http_address}", timeout=20)


async def test_browsers_get_the_page_and_programs_a_directory(client: httpx.AsyncClient) -> None:
    page = await client.get("/", headers=BROWSER)
    assert page.headers["content-type"].startswith("text/html")
    directory = (await client.get("/")).json()
    assert directory["name"] == "cab-forecast"
    assert directory["methods"]["WatchForecasts"] == "GET /v1/scenes/{scene_id}/forecasts/watch"
    for path in (directory["live"], directory["ready"]):
        assert (await client.get(path)).status_code == 200
    assert {page.headers["vary"], (await client.get("/")).headers["vary"]} == {"Accept"}


async def test_everything_that_the_page_loads_is_there_and_safe(client: httpx.AsyncClient) -> None:
    page = await client.get("/", headers=BROWSER)
    loaded = re.findall(r'(?:src|href)="(/?console/[^"#]+)', page.text)
    for path in ["console/index.html", *loaded]:
        response = await client.get(path)
        assert response.status_code == 200, path
        policy = response.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "script-src 'self';" in policy
        assert "unsafe" not in policy
        assert response.headers["x-content-type-options"] == "nosniff"
    assert page.headers["content-security-policy"] == policy


async def test_browsers_ask_for_changes_only(client: httpx.AsyncClient) -> None:
    first = await client.get("/console/index.html")
    again = await client.get("/console/index.html", headers={"if-none-match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_no_file_of_the_console_needs_what_the_policy_forbids() -> None:
    folder = resources.files("service") / "console"
    for file in folder.iterdir():
        text = file.read_bytes().decode(errors="replace")
        assert not re.search(r"(?:src|href)\s*=\s*[\"'](?:https?:)?//", text), file.name
        if file.name.endswith(".html"):
            assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\sstyle=|\son\w+=", text), file.name


@pytest.mark.parametrize("path", ["/console/nothing.js", "/console/%2e%2e/settings.py", "/console/"])
async def test_there_are_no_other_files(client: httpx.AsyncClient, path: str) -> None:
    assert from_problem(await client.get(path)).reason == "NO_SUCH_ADDRESS"


async def test_data_needs_the_key(client: httpx.AsyncClient) -> None:
    for path in ("/v1/scenes", "/v1/scenes/s/forecasts/watch", "/metrics"):
        assert from_problem(await client.get(path)).reason == "UNAUTHENTICATED"
    assert (await client.get("/v1/scenes", headers={"authorization": "Bearer token"})).status_code == 200


@pytest.mark.parametrize(
    ("values", "closed", "shown"),
    [
        ({}, False, True),
        ({"http": "0.0.0.0:80", "allow_anyone": True}, False, False),
        ({"http": "0.0.0.0:80"}, True, True),
        ({"http": "0.0.0.0:80", "allow_anyone": True, "console": True}, False, True),
        ({"console": False}, False, False),
    ],
)
def test_where_it_is_on(values: dict[str, Any], closed: bool, shown: bool) -> None:
    assert console_is_on(Settings(**values), closed=closed) is shown


async def test_it_can_be_turned_off() -> None:
    async with running(FakeForecaster(), console=False) as server, client_of(server) as client:
        assert (await client.get("/", headers=BROWSER)).headers["content-type"] == "application/json"
        assert from_problem(await client.get("/console/index.html")).reason == "NO_SUCH_ADDRESS"
