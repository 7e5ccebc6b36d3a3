"""The examples in Python run as their README says, and end as they should."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from service.server import Server
from tests.docs.pages import ROOT
from tests.examples.conftest import Run, line, run

LOOP, NOTEBOOK = "python/closed_loop.py", "python/notebook/forecasts.ipynb"


def test_the_closed_loop(start: Callable[[str], Run], server: Server, tmp_path: Path) -> None:
    sent, named = (_lookups(server, source) for source in ("sent", "memory"))
    done = run(line(LOOP).replace("--seconds 20", "--seconds 3 --deadline 10"), server, tmp_path)
    assert done.returncode == 0, done.stderr
    *seconds, last = done.stdout.splitlines()
    assert len(seconds) == 3
    answered = int(last.split()[0])
    assert answered == 30
    assert " OK" in seconds[-1]
    assert re.search(r"off by \d+\.\d\d m on average; 0 events missed", last)
    # The map was sent once, after that its digest
    assert _lookups(server, "sent") - sent == 1
    assert _lookups(server, "memory") - named == 29


def test_the_loop_without_a_server(start: Callable[[str], Run], server: Server, tmp_path: Path) -> None:
    done = run(line(LOOP).replace(".venv", "CAB_FORECAST_ENDPOINT=127.0.0.1:1 .venv"), server, tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("UNAVAILABLE: no connection to grpc://127.0.0.1:1")


def test_the_notebook(start: Callable[[str], Run], tmp_path: Path) -> None:
    done = start(NOTEBOOK)
    assert done.returncode == 0, done.stderr
    cells = _code(tmp_path / "examples" / NOTEBOOK)
    outputs = [one for cell in cells for one in cell["outputs"]]
    assert sum("image/png" in one.get("data", {}) for one in outputs) == 3
    text = "".join("".join(one.get("text", "")) for one in outputs)
    assert "trajectron@" in text
    assert re.search(r"vehicle-\d+ +25 modes, merged \d+, weights", text)
    shown = [one["data"]["text/plain"] for one in outputs if "text/html" in one.get("data", {})]
    tables = "".join("".join(lines) for lines in shown)
    assert "donors" in tables or "null context" in tables


def test_the_notebook_is_stored_without_outputs() -> None:
    for cell in _code(ROOT / "examples" / NOTEBOOK):
        assert cell["outputs"] == []
        assert cell["execution_count"] is None


def test_messages_of_autoware(start: Callable[[str], Run]) -> None:
    done = start("python/autoware.py")
    assert done.returncode == 0, done.stderr
    assert f"{'11' * 16} FORECAST_STATUS_OK" in done.stderr
    objects = json.loads(done.stdout)["objects"]
    assert len(objects) == 3
    for one in objects:
        paths = one["kinematics"]["predicted_paths"]
        assert abs(sum(path["confidence"] for path in paths) - 1) < 1e-6
        assert {len(path["path"]) for path in paths} == {13}
    car = objects[0]["kinematics"]["predicted_paths"][0]["path"]
    assert car[-1]["position"]["y"] > car[0]["position"]["y"] + 10  # it drives north


def test_what_the_server_refuses_is_said(start: Callable[[str], Run], server: Server, tmp_path: Path) -> None:
    file = tmp_path / "examples/python/tracked_objects.json"
    file.write_text(file.read_text().replace('"x": 3700.0,', '"x": 1e9,'))
    done = run(line("python/autoware.py"), server, tmp_path)
    assert done.returncode == 0, done.stderr
    assert f"{'11' * 16} FORECAST_STATUS_INVALID" in done.stderr
    assert json.loads(done.stdout)["objects"][0]["kinematics"]["predicted_paths"] == []
    file.write_text(file.read_text().replace('"frame_id": "map"', '"frame_id": "base_link"'))
    done = run(line("python/autoware.py"), server, tmp_path)
    assert done.returncode == 1
    assert done.stderr == 'positions must be in the frame "map", not "base_link"\n'


def _code(notebook: Path) -> list[Any]:
    book = json.loads(notebook.read_text(encoding="utf-8"))
    return [cell for cell in book["cells"] if cell["cell_type"] == "code"]


def _lookups(server: Server, source: str) -> float:
    labels = {"source": source}
    return server.metrics.registry.get_sample_value("forecast_raster_lookups_total", labels) or 0.0
