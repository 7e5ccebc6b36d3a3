"""What is installed is what is there: the wheel, the image, and the files that say so."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def packages() -> set[str]:
    """Top-level folders that the wheel holds."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    listed = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    return {Path(name).parts[0] for name in listed}


def test_the_image_is_built_from_all_packages() -> None:
    copied = {
        words[1]
        for words in map(str.split, (ROOT / "Dockerfile").read_text().splitlines())
        if words[:1] == ["COPY"] and len(words) == 3 and words[1] == words[2]
    }
    assert copied == packages()
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert packages() <= sent


def test_every_package_is_type_checked_and_says_so() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    checked = set(project["tool"]["mypy"]["packages"]) | {"proto"}
    assert packages() <= checked
    for name in packages() - {"proto"}:
        assert (ROOT / name / "py.typed").is_file(), name


def test_who_reads_the_licence_sees_that_the_weights_have_another() -> None:
    """The wheel holds checkpoints trained on nuScenes."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert (ROOT / "model/checkpoints").is_dir()
    assert project["project"]["license"] == "Apache-2.0 AND LicenseRef-nuScenes-NonCommercial"
