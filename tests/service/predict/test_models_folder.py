"""The folder of models: what is loaded, passed over, refused and kept."""

import json
import shutil
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from model.checkpoint import save_checkpoint
from service.predict.models_folder import FolderModels, fingerprint, load_models
from service.settings import Settings, SettingsError
from tests.model.checkpoints import copy_bundled, info, network, tensors

SMALL = "trajectron-no-context"


def own(folder: Path) -> Settings:
    return Settings(models=folder)


def checkpoints(models: FolderModels) -> list[str]:
    """Return the full names of the models that come from checkpoints."""
    return [source.info.full_name for source in models.sources.values() if source.forecaster is not None]


def test_foreign_folders_are_passed_over_with_a_warning(tmp_path: Path) -> None:
    copy_bundled(tmp_path / "one", SMALL, "2.0.0")
    (tmp_path / "lost+found").mkdir()
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "config.json").mkdir()  # it cannot be read as a file
    (tmp_path / ".cache").mkdir()
    with capture_logs() as logs:
        models = load_models(own(tmp_path))
    assert checkpoints(models) == [f"{SMALL}@2.0.0"]
    assert models.refused == ()
    warned = {Path(entry["folder"]).name: entry["reason"] for entry in logs}
    assert warned == {"lost+found": "it holds no config.json", "odd": "it cannot be read: Is a directory"}
    assert {entry["log_level"] for entry in logs} == {"warning"}


def test_what_has_not_changed_is_taken_over(tmp_path: Path) -> None:
    copy_bundled(tmp_path / "one", SMALL, "2.0.0")
    first = load_models(own(tmp_path))
    (tmp_path / "one").rename(tmp_path / "renamed")
    copy_bundled(tmp_path / "two", SMALL, "2.1.0")
    second = load_models(own(tmp_path), first)
    assert second.get(f"{SMALL}@2.0.0") is first.get(SMALL)
    assert second.get("kalman") is first.get("kalman")
    assert second.get(SMALL).info.version == "2.1.0"
    shutil.rmtree(tmp_path / "renamed")
    assert checkpoints(load_models(own(tmp_path), second)) == [f"{SMALL}@2.1.0"]


@pytest.mark.parametrize("damage", ["config", "no config", "weights", "other config"])
def test_the_old_one_stays_where_the_new_one_is_damaged(tmp_path: Path, damage: str) -> None:
    folder = copy_bundled(tmp_path / "one", SMALL, "2.0.0")
    first = load_models(own(tmp_path))
    config = folder / "config.json"
    match damage:
        case "config":
            config.write_text("{")
        case "no config":
            config.unlink()
        case "weights":  # the configuration is new, and the weights were not copied whole
            shutil.rmtree(folder)
            copy_bundled(folder, SMALL, "2.1.0")
            (folder / "model.safetensors").write_bytes(b"1234")
        case "other config":
            config.write_text((copy_bundled(tmp_path / ".other") / "config.json").read_text())
    with capture_logs() as logs:
        second = load_models(own(tmp_path), first)
    (refused,) = second.refused
    assert refused.folder == "one"
    assert second.get(SMALL) is first.get(SMALL)
    (entry,) = logs
    assert (entry["event"], entry["stays"]) == ("model refused", f"{SMALL}@2.0.0")
    assert entry["reason"] == refused.reason


def test_a_model_that_fails_the_canary_scene_is_refused(tmp_path: Path) -> None:
    copy_bundled(tmp_path / "good", SMALL, "2.0.0")
    wild = {name: 100 * tensor for name, tensor in tensors().items()}
    save_checkpoint(tmp_path / "random", info(name="random"), network(), wild, "")
    models = load_models(own(tmp_path))
    assert checkpoints(models) == [f"{SMALL}@2.0.0"]
    (refused,) = models.refused
    assert refused.folder == "random"
    assert "canary scene" in refused.reason


def test_other_weights_need_another_version(tmp_path: Path) -> None:
    folder = copy_bundled(tmp_path / "one", SMALL, "2.0.0")
    first = load_models(own(tmp_path))
    shutil.rmtree(folder)
    copy_bundled(folder, "cab")
    config = json.loads((folder / "config.json").read_text())
    config["info"] |= {"name": SMALL, "version": "2.0"}  # the same version, otherwise spelt
    (folder / "config.json").write_text(json.dumps(config))
    second = load_models(own(tmp_path), first)
    assert "served with other weights; new weights need a new version" in second.refused[0].reason
    assert second.get(SMALL) is first.get(SMALL)


def test_two_folders_with_one_model(tmp_path: Path) -> None:
    copy_bundled(tmp_path / "b", SMALL, "2.0.0")
    first = load_models(own(tmp_path))
    copy_bundled(tmp_path / "a", SMALL, "2.0.0")
    second = load_models(own(tmp_path), first)
    assert second.refused[0].folder == "a"
    assert "is in the folder b already" in second.refused[0].reason
    assert checkpoints(second) == [f"{SMALL}@2.0.0"]


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="models: no such folder"):
        load_models(own(tmp_path / "nowhere"))


def test_the_fingerprint_changes_with_the_checkpoints(tmp_path: Path) -> None:
    assert fingerprint(None) == fingerprint(tmp_path) == frozenset()
    copy_bundled(tmp_path / "one", SMALL, "2.0.0")
    (tmp_path / "lost+found").mkdir()
    before = fingerprint(tmp_path)
    assert len(before) == 2
    assert fingerprint(tmp_path) == before
    copy_bundled(tmp_path / "two", SMALL, "2.1.0")
    assert fingerprint(tmp_path) > before
