"""``cab-forecast map``, and ``predict --map``."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image
from typer.testing import CliRunner

from cab.forecast.v1.prediction_service_pb2 import PredictRequest, SceneRaster
from cab_forecast import raster_digest
from cab_forecast.maps import read_map
from cli.main import app
from cli.messages import read_message
from tests.cab_forecast.fakes import Script, grpc_fake

JUNCTION = Path(__file__).resolve().parents[2] / "docs/data/junction.geojson"

run = CliRunner().invoke


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Iterator[Script]:
    """Run a fake server at the command's default endpoint, and return its script."""
    script = Script()
    with grpc_fake(script) as address:
        monkeypatch.setenv("CAB_FORECAST_ENDPOINT", f"grpc://{address}")
        yield script


def test_says_what_the_map_holds_and_writes_the_cut(tmp_path: Path) -> None:
    out, picture = tmp_path / "cut.binpb", tmp_path / "cut.png"
    options = ["--center", "-5,20", "--size", "90", "--plot", str(picture), "--out", str(out)]
    result = run(app, ["map", str(JUNCTION), *options])
    assert result.exit_code == 0, result.output
    assert "layers:  driveable area 1, road dividers 3, lane dividers 4" in result.stdout
    assert "extent:  x -150.0 … 150.0 m, y -7.0 … 120.0 m" in result.stdout
    raster = read_message(str(out), SceneRaster())
    assert raster == read_map(JUNCTION).cut((-5, 20), 90.0)
    assert f"digest:  {raster_digest(raster).hex()}" in result.stdout
    colors = Image.open(picture).convert("RGB").getcolors(1 << 24)
    assert colors is not None
    assert {(0xD3, 0xD7, 0xDD), (0xD9, 0x9A, 0x1C), (0xFF, 0xFF, 0xFF)} <= {color for _, color in colors}


@pytest.mark.parametrize("name", ["cut.json", "cut.binpb"])
def test_predict_takes_the_cut(tmp_path: Path, script: Script, name: str) -> None:
    assert run(app, ["map", str(JUNCTION), "--out", str(tmp_path / name)]).exit_code == 0
    result = run(app, ["predict", "demo", "--map", str(tmp_path / name)])
    assert result.exit_code == 0, result.output
    assert script.predicted[0].scene_raster == read_message(str(tmp_path / name), SceneRaster())


def test_predict_refuses_other_files_as_maps(tmp_path: Path, script: Script) -> None:
    (tmp_path / "request.binpb").write_bytes(PredictRequest(time=1.0).SerializeToString())
    for file, message in (
        (tmp_path / "request.binpb", "holds no SceneRaster"),
        (JUNCTION, "holds no SceneRaster"),
        (tmp_path / "missing.json", "No such file"),
    ):
        result = run(app, ["predict", "demo", "--map", str(file)])
        assert result.exit_code == 1
        assert message in result.stderr
    assert not script.predicted


def test_properties_of_geojson(tmp_path: Path) -> None:
    content = json.loads(JUNCTION.read_text(encoding="utf-8"))
    content["features"] = [{**content["features"][0], "properties": {"class": "street"}}]
    path = tmp_path / "town.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    options = ["--layer-property", "class", "--layer", "driveable_area=road,street"]
    result = run(app, ["map", str(path), *options])
    assert result.exit_code == 0, result.output
    assert "note:    no lane dividers: models see none" in result.stdout


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--center", "900,0"], "no driveable area lies within 150 m of (900.0, 0.0)"),
        (["--center", "900"], "--center takes two numbers with a comma between them, not '900'"),
        (["--origin", "49;8"], "--origin takes two numbers"),
        (["--size", "5000"], "at most 1365 m"),
        (["--layer", "driveable_area"], "--layer takes LAYER=VALUE,VALUE"),
        (["--layer", "walkway=path"], "there is no layer 'walkway'"),
        (["--format", "shapefile"], "formats of maps are nuscenes"),
        (["--out", "/nowhere/cut.json"], "No such file"),
    ],
)
def test_errors_are_one_line(options: list[str], message: str) -> None:
    result = run(app, ["map", str(JUNCTION), *options])
    assert result.exit_code == 1
    assert message in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_without_shapely_there_is_a_hint(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("cab_forecast.maps")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "shapely", None)
    result = run(app, ["map", str(JUNCTION)])
    assert result.exit_code == 1
    assert 'pip install "cab-forecast[maps]"' in result.stderr
