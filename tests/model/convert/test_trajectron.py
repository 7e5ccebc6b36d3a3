import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from model.checkpoint import load_checkpoint
from model.convert import ConversionError, UnsafePickleError, convert_trajectron
from model.forecaster import Context, Protocol
from model.networks.cvae import AgentNetwork
from model.networks.forecaster import CvaeForecaster
from model.scenes.scene import AgentType
from tests.model.convert.assembler import call, legacy_file, module, named, text


@pytest.fixture
def source(shared: Path, tmp_path: Path) -> Path:
    """The published checkpoint, where it can be changed."""
    copy = tmp_path / "published"
    copy.mkdir()
    for file in (shared / "reference/weights/trajectron_int_ee_me").iterdir():
        shutil.copyfile(file, copy / file.name)
    return copy


def _edit(source: Path, change: Callable[[dict[str, Any]], object]) -> None:
    settings = json.loads((source / "config.json").read_text())
    change(settings)
    (source / "config.json").write_text(json.dumps(settings))


def test_the_published_checkpoint(source: Path, tmp_path: Path) -> None:
    out = tmp_path / "models" / "trajectron"
    convert_trajectron(source, 12, out)
    checkpoint = load_checkpoint(out)
    info = checkpoint.info
    assert (info.name, info.version, info.protocol) == ("trajectron", "0.12.0", Protocol.PAPER)
    assert info.agent_types == info.context_types == (AgentType.VEHICLE, AgentType.PEDESTRIAN)
    assert (info.history_frames, info.modes, info.supports_blind) == (9, 25, False)
    assert info.uses_map
    assert info.uses_neighbors
    assert "MIT" in info.license
    assert "non-commercial" in info.license
    assert (out / "LICENSE").read_text().startswith("MIT License")
    assert "Protocol: paper" in (out / "README.md").read_text()
    assert isinstance(checkpoint.forecaster(), CvaeForecaster)


@pytest.mark.parametrize("kind", ["vehicle", "pedestrian"])
def test_its_probabilities_are_the_golden_ones(
    shared: Path, source: Path, tmp_path: Path, kind: AgentType
) -> None:
    golden = np.load(shared / f"reference/golden/trajectron_nuscenes/{kind}_outputs.npz")
    convert_trajectron(source, 12, tmp_path / "out")
    forecaster = load_checkpoint(tmp_path / "out").forecaster()
    assert isinstance(forecaster, CvaeForecaster)
    network = forecaster.networks.of(AgentType(kind))
    assert isinstance(network, AgentNetwork)
    logits = network.prior(torch.from_numpy(golden["encoding"]), Context.FULL)
    np.testing.assert_allclose(logits.softmax(-1), golden["z_probs"], atol=1e-6)


def test_a_license_is_not_needed(source: Path, tmp_path: Path) -> None:
    (source / "LICENSE").unlink()
    convert_trajectron(source, 12, tmp_path / "out")
    assert not (tmp_path / "out" / "LICENSE").exists()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda s: s.update(K=24), "K is 24, not 25"),
        (lambda s: s.pop("K"), "K is missing"),
        (lambda s: s.update(dec_rnn_dim=64), "dec_rnn_dim is 64"),
        (lambda s: s.update(use_map_encoding=False), "use_map_encoding is False"),
        (lambda s: s.update(incl_robot_node=True), "incl_robot_node is True"),
        (lambda s: s.update(override_attention_radius=["VEHICLE VEHICLE 50"]), "override_attention_radius"),
        (lambda s: s["map_encoder"]["VEHICLE"].update(patch_size=[50, 50, 50, 50]), "patch_size is"),
        (lambda s: s["dynamic"]["VEHICLE"].update(name="Bicycle"), "dynamic.VEHICLE.name is 'Bicycle'"),
        (lambda s: s.update(state=[]), "state.VEHICLE is missing"),
        (lambda s: s.update(maximum_history_length=0), "maximum_history_length is 0"),
        (lambda s: s.update(maximum_history_length=True), "maximum_history_length is True"),
    ],
)
def test_other_networks_are_refused(
    source: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object], told: str
) -> None:
    _edit(source, change)
    with pytest.raises(ConversionError) as caught:
        convert_trajectron(source, 12, tmp_path / "out")
    assert told in str(caught.value)
    assert "config.json" in str(caught.value)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("text_", ["", "[", "[" * 100_000])
def test_settings_that_are_no_json(source: Path, tmp_path: Path, text_: str) -> None:
    (source / "config.json").write_text(text_)
    with pytest.raises(ConversionError, match="not JSON"):
        convert_trajectron(source, 12, tmp_path / "out")


def test_files_that_are_not_there(source: Path, tmp_path: Path) -> None:
    with pytest.raises(ConversionError, match=r"model_registrar-13\.pt: cannot be read"):
        convert_trajectron(source, 13, tmp_path / "out")
    with pytest.raises(ConversionError, match=r"config\.json: cannot be read"):
        convert_trajectron(tmp_path, 12, tmp_path / "out")
    with pytest.raises(ConversionError, match="overwrite its source"):
        convert_trajectron(source, 12, source)


def test_a_pickle_that_would_run_something(source: Path, tmp_path: Path) -> None:
    bomb = legacy_file(module(modules={"a": call(named("os", "system"), text("true"))}))
    (source / "model_registrar-12.pt").write_bytes(bomb)
    with pytest.raises(UnsafePickleError, match=r"os\.system"):
        convert_trajectron(source, 12, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_missing_tensors_are_named(source: Path, tmp_path: Path) -> None:
    (source / "model_registrar-12.pt").write_bytes(legacy_file(module()))
    with pytest.raises(ConversionError, match="is missing"):
        convert_trajectron(source, 12, tmp_path / "out")


def test_truncated_and_disturbed_weights(source: Path, tmp_path: Path) -> None:
    file = source / "model_registrar-12.pt"
    data = file.read_bytes()
    file.write_bytes(data[:-1000])
    with pytest.raises(ConversionError, match="the file ends before"):
        convert_trajectron(source, 12, tmp_path / "out")
    file.write_bytes(data[:-4] + np.float32(np.nan).tobytes())
    with pytest.raises(ConversionError, match="not all parameters are finite"):
        convert_trajectron(source, 12, tmp_path / "out")
