import subprocess
import sys
from pathlib import Path

import pytest

from model.baselines.kalman import Kalman
from model.checkpoint import CheckpointError, save_checkpoint
from model.forecaster import Forecaster, ModelInfo, Protocol
from model.registry import DuplicateModelError, Registry, UnknownModelError
from tests.model.checkpoints import info, network, tensors

BASELINES = [
    "constant-acceleration-yaw",
    "constant-acceleration-yaw-rate",
    "constant-speed-yaw-rate",
    "constant-velocity-yaw",
    "kalman",
]


def _save(folder: Path, name: str, version: str, protocol: Protocol = Protocol.CAUSAL) -> None:
    save_checkpoint(folder, info(name=name, version=version, protocol=protocol), network(), tensors(), "")


def _kalman(version: str) -> Forecaster:
    forecaster = Kalman()
    forecaster.info = ModelInfo.model_validate(forecaster.info.model_dump() | {"version": version})
    return forecaster


def test_the_baselines_need_no_checkpoint() -> None:
    registry = Registry.load(None)
    assert [model.name for model in registry.infos()] == BASELINES
    for name in BASELINES:
        assert registry.get(name).info.name == name


def test_checkpoints_join_the_baselines(tmp_path: Path) -> None:
    _save(tmp_path / "one", "cab", "1.0.0")
    _save(tmp_path / "two", "trajectron", "0.3.0")
    (tmp_path / ".partial").mkdir()
    (tmp_path / "README.md").write_text("not a checkpoint")
    registry = Registry.load(tmp_path)
    assert [model.name for model in registry.infos()] == sorted([*BASELINES, "cab", "trajectron"])
    assert registry.get("cab").info.version == "1.0.0"


def test_the_newest_version_unless_pinned() -> None:
    registry = Registry(_kalman(version) for version in ("1.9.0", "1.10.0", "1.10.0rc1", "0.2"))
    assert registry.get("kalman").info.version == "1.10.0"
    assert registry.get("kalman@1.9.0").info.version == "1.9.0"
    assert registry.get("kalman@1.9").info.version == "1.9.0"
    assert [model.version for model in registry.infos()] == ["0.2", "1.9.0", "1.10.0rc1", "1.10.0"]


@pytest.mark.parametrize("name", ["", "cab", "kalman@2.0.0", "kalman@", "kalman@newest", "@1.0.0", "KALMAN"])
def test_an_unknown_model_is_told_what_there_is(name: str) -> None:
    registry = Registry([_kalman("1.0.0"), _kalman("1.1.0")])
    with pytest.raises(UnknownModelError) as caught:
        registry.get(name)
    assert str(caught.value) == f"there is no model {name!r}; there are kalman@1.0.0, kalman@1.1.0"
    assert caught.value.name == name
    assert caught.value.available == ("kalman@1.0.0", "kalman@1.1.0")
    assert name not in registry


def test_contains() -> None:
    registry = Registry([_kalman("1.0.0")])
    assert "kalman" in registry
    assert "kalman@1.0.0" in registry
    assert 3 not in registry


def test_an_empty_registry_says_so() -> None:
    with pytest.raises(UnknownModelError, match="there are none"):
        Registry([]).get("kalman")


def test_two_of_the_same_name_and_version_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DuplicateModelError, match=r"two models kalman@1\.0"):
        Registry([_kalman("1.0.0"), _kalman("1.0")])
    _save(tmp_path / "one", "kalman", "1.0.0")
    with pytest.raises(DuplicateModelError, match=r"two models kalman@1\.0\.0"):
        Registry.load(tmp_path)


def test_models_of_the_paper_protocol_must_be_asked_for(tmp_path: Path) -> None:
    _save(tmp_path / "peeks", "trajectron", "0.12.0", Protocol.PAPER)
    with pytest.raises(CheckpointError, match="paper protocol") as caught:
        Registry.load(tmp_path)
    assert caught.value.file == tmp_path / "peeks"
    assert "trajectron" in Registry.load(tmp_path, allow_paper=True)


def test_beside_others_they_are_passed_over_and_said_to_be(tmp_path: Path) -> None:
    _save(tmp_path / "cab", "cab", "1.0.0")
    _save(tmp_path / "cab-paper", "cab", "1.0.0+paper", Protocol.PAPER)
    registry = Registry.load(tmp_path)
    assert [model.name for model in registry.infos()] == ["cab", *BASELINES]
    assert [model.version for model in registry.passed_over] == ["1.0.0+paper"]
    with pytest.raises(UnknownModelError, match=r"not allowed, so cab@1\.0\.0\+paper was not loaded"):
        registry.get("cab@1.0.0+paper")
    with pytest.raises(UnknownModelError, match=r"kalman@1\.0\.0$"):
        registry.get("nobody")
    assert not Registry.load(tmp_path, allow_paper=True).passed_over


def test_a_name_alone_is_the_causal_model(tmp_path: Path) -> None:
    for version, protocol in (
        ("1.0.0", Protocol.CAUSAL),
        ("1.0.0+paper", Protocol.PAPER),
        ("2.0.0+paper", Protocol.PAPER),
    ):
        _save(tmp_path / version, "cab", version, protocol)
    _save(tmp_path / "old", "trajectron", "1.0.0+paper", Protocol.PAPER)
    _save(tmp_path / "new", "trajectron", "1.1.0+paper", Protocol.PAPER)
    registry = Registry.load(tmp_path, allow_paper=True)
    found = {name: registry.get(name).info for name in ("cab", "cab@1.0.0+paper", "cab@2.0.0+paper")}
    assert [info.version for info in found.values()] == ["1.0.0", "1.0.0+paper", "2.0.0+paper"]
    assert [info.protocol.value for info in found.values()] == ["causal", "paper", "paper"]
    assert registry.get("trajectron").info.version == "1.1.0+paper"


def test_a_damaged_checkpoint_is_not_passed_over(tmp_path: Path) -> None:
    _save(tmp_path / "one", "cab", "1.0.0")
    (tmp_path / "one" / "model.safetensors").write_bytes(b"")
    with pytest.raises(CheckpointError, match=r"model\.safetensors"):
        Registry.load(tmp_path)


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no such folder"):
        Registry.load(tmp_path / "nowhere")


def test_importing_the_registry_does_not_import_torch() -> None:
    code = "import sys, model.registry; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0  # noqa: S603
