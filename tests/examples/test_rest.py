"""The example with curl runs as its README says."""

import json
import shutil
from collections.abc import Callable
from typing import Any

import pytest

from service.server import Server
from tests.examples.conftest import Run, line, run

pytestmark = pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not here")


def test_curl(start: Callable[[str], Run]) -> None:
    done = start("rest/curl.sh")
    assert done.returncode == 0, done.stderr
    parts = dict(part.split("\n", 1) for part in done.stdout.split("== ")[1:])
    [model] = _documents(parts["Models"])
    assert model["model"]["name"] == "cab"
    [forecast] = _documents(parts["A forecast"])
    assert [one["status"] for one in forecast["forecasts"]] == ["FORECAST_STATUS_OK"]
    problem, answer = _documents(parts["An error: problem+json names the field"])
    assert problem["errors"][0]["field"] == "options.horizon"
    assert answer == {"http_status": 422, "content_type": "application/problem+json"}
    events = _documents(parts["Live forecasts of the scene"])
    assert any("car" in json.dumps(event.get("frame", {})) for event in events)
    [scenes] = _documents(parts["Live scenes"])
    assert scenes["scenes"][0]["scene_id"].startswith("curl-")


def test_without_a_server_it_says_so(start: Callable[[str], Run], server: Server, tmp_path: Any) -> None:
    done = run(line("rest/curl.sh").replace("127.0.0.1:8080", "127.0.0.1:1"), server, tmp_path)
    assert done.returncode == 7
    assert done.stdout == ""
    assert done.stderr.startswith("curl: (7) Failed to connect")


def _documents(text: str) -> list[Any]:
    """Return the JSON documents that follow each other in a text."""
    decoder, found = json.JSONDecoder(), []
    while text := text.lstrip():
        document, end = decoder.raw_decode(text)
        found.append(document)
        text = text[end:]
    return found
