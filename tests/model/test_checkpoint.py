import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from torch import Tensor

from model.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from model.forecaster import ModelInfo
from model.networks.config import NetworkConfig
from model.networks.forecaster import CvaeForecaster
from tests.model.checkpoints import info, network, tensors


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A whole checkpoint."""
    folder = tmp_path / "some" / "model"
    save_checkpoint(folder, info(), network(), tensors(), "# A model\n")
    return folder


def _edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes config.json."""
    file = folder / "config.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def _rewrite(folder: Path, change: Callable[[dict[str, Tensor]], object]) -> None:
    """Changes the tensors, and the digest with them."""
    changed = tensors()
    change(changed)
    save_checkpoint(folder, info(), network(), changed, "")


def _fault(folder: Path, file: str) -> str:
    """Return the fault that loading the checkpoint and making its model finds in that file."""
    with pytest.raises(CheckpointError) as caught:
        load_checkpoint(folder).forecaster()
    assert caught.value.file == folder / file
    assert str(folder / file) in str(caught.value)
    return caught.value.fault


def test_what_was_saved_is_loaded(folder: Path) -> None:
    checkpoint = load_checkpoint(folder)
    assert checkpoint.folder == folder
    assert checkpoint.info == info()
    assert checkpoint.network == network()
    assert checkpoint.tensors.keys() == tensors().keys()
    for name, tensor in tensors().items():
        assert torch.equal(checkpoint.tensors[name], tensor)
    assert (folder / "README.md").read_text() == "# A model\n"
    assert {file.name for file in folder.iterdir()} == {"README.md", "config.json", "model.safetensors"}


def test_its_model(folder: Path) -> None:
    forecaster = load_checkpoint(folder).forecaster()
    assert isinstance(forecaster, CvaeForecaster)
    assert forecaster.info == info()


def test_saving_again_replaces(folder: Path) -> None:
    _rewrite(folder, lambda all_: all_.update({name: tensor + 1 for name, tensor in all_.items()}))
    save_checkpoint(folder, info(version="2.0.0"), network(), tensors(), "")
    assert load_checkpoint(folder).info.version == "2.0.0"


@pytest.mark.parametrize("file", ["config.json", "model.safetensors"])
def test_a_missing_file(folder: Path, file: str) -> None:
    (folder / file).unlink()
    assert "no such file" in _fault(folder, file)


def test_a_missing_folder(tmp_path: Path) -> None:
    assert "no such file" in _fault(tmp_path / "nowhere", "config.json")


def test_a_folder_in_place_of_a_file(folder: Path) -> None:
    (folder / "config.json").unlink()
    (folder / "config.json").mkdir()
    assert "cannot be read" in _fault(folder, "config.json")


@pytest.mark.parametrize("text", ["", "{", '{"a": NaN', "[" * 100_000, "\x00"])
def test_bad_json(folder: Path, text: str) -> None:
    (folder / "config.json").write_text(text)
    assert "not JSON" in _fault(folder, "config.json")


def test_bytes_that_are_no_text(folder: Path) -> None:
    (folder / "config.json").write_bytes(b"\xff\xfe\xff")
    assert "not JSON" in _fault(folder, "config.json")


@pytest.mark.parametrize("text", ["[]", "3", "null", "{}"])
def test_json_of_something_else(folder: Path, text: str) -> None:
    (folder / "config.json").write_text(text)
    assert _fault(folder, "config.json")


def test_an_unknown_format_version_is_said_before_all_else(folder: Path) -> None:
    _edit(folder, lambda content: content.update(format_version=2, something_new=1))
    assert _fault(folder, "config.json") == "format version 2 is not known; this release reads version 1"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda c: c.pop("format_version"), "format_version: Field required"),
        (lambda c: c.update(extra=1), "extra: Extra inputs"),
        (lambda c: c["info"].pop("name"), "info.name: Field required"),
        (lambda c: c["info"].update(protocol="psychic"), "info.protocol"),
        (lambda c: c["info"].update(version="newest"), "not a version (PEP 440)"),
        (lambda c: c["network"].update(kind="oracle"), "network: kind must be cvae or covernet"),
        (lambda c: c["network"].update(modes=-1), "network.cvae.modes"),
    ],
)
def test_faults_in_the_config_are_named(
    folder: Path, change: Callable[[dict[str, Any]], object], told: str
) -> None:
    _edit(folder, change)
    assert told in _fault(folder, "config.json")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("agent_types", ["vehicle", "pedestrian"]),
        ("context_types", []),
        ("modes", 24),
        ("uses_map", False),
        ("uses_neighbors", False),
        ("supports_blind", True),
    ],
)
def test_info_that_does_not_fit_the_network(folder: Path, field: str, value: object) -> None:
    _edit(folder, lambda content: content["info"].update({field: value}))
    assert f"does not fit the network in {field}" in _fault(folder, "config.json")
    bad = ModelInfo.model_validate(info().model_dump() | {field: value})
    with pytest.raises(ValueError, match=field):
        save_checkpoint(folder, bad, network(), tensors(), "")


@pytest.mark.parametrize("keep", [0, 4, 100, 50_000])
def test_truncated_tensors(folder: Path, keep: int) -> None:
    file = folder / "model.safetensors"
    file.write_bytes(file.read_bytes()[:keep])
    assert "not a whole safetensors file" in _fault(folder, "model.safetensors")


def test_a_pickle_in_place_of_tensors(folder: Path) -> None:
    torch.save({"a": torch.ones(2)}, folder / "model.safetensors")
    assert "not a whole safetensors file" in _fault(folder, "model.safetensors")


def test_tensors_of_another_checkpoint(folder: Path) -> None:
    other = {name: tensor + 1 for name, tensor in tensors().items()}
    safetensors.torch.save_file(other, folder / "model.safetensors")
    assert "SHA-256 differs" in _fault(folder, "model.safetensors")


NAME = "vehicle.full.decoder.mean.weight"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda t: t.pop(NAME), f"{NAME} is missing"),
        (lambda t: t.update(stray=torch.ones(1)), "stray is not of this network"),
        (lambda t: t.update({NAME: torch.ones(2, 127)}), f"{NAME} is [2, 127], not [2, 128]"),
        (lambda t: t.update({NAME: torch.ones(2, 128, dtype=torch.float16)}), "float16"),
    ],
)
def test_tensors_that_do_not_fit(
    folder: Path, change: Callable[[dict[str, Tensor]], object], told: str
) -> None:
    _rewrite(folder, change)
    assert told in _fault(folder, "model.safetensors")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_tensors_that_are_not_finite(folder: Path, value: float) -> None:
    bad = tensors()
    bad[NAME][1, 3] = value
    with pytest.raises(CheckpointError, match=f"{NAME} holds numbers that are not finite"):
        save_checkpoint(folder, info(), network(), bad, "")
    _forge(folder, bad)
    assert _fault(folder, "model.safetensors") == f"{NAME} holds numbers that are not finite"


def _forge(folder: Path, forged: dict[str, Tensor]) -> None:
    """Writes tensors as save_checkpoint would if it did not check them."""
    import hashlib

    data = safetensors.torch.save(forged)
    (folder / "model.safetensors").write_bytes(data)
    _edit(folder, lambda content: content.update(tensors_sha256=hashlib.sha256(data).hexdigest()))


def test_a_network_of_two_types(tmp_path: Path) -> None:
    config = NetworkConfig.model_validate({"agent_types": ["vehicle", "pedestrian"], "blind": "own"})
    save_checkpoint(tmp_path, info(config), config, tensors(config), "")
    assert load_checkpoint(tmp_path).forecaster().info.supports_blind
