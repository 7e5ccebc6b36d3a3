"""``cab-forecast convert``; what it calls has its own tests."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

import model.convert
from cli.main import app
from model.checkpoint import CheckpointError
from model.convert import UnsafePickleError


def run(*arguments: str) -> tuple[int, str, str]:
    """Return the exit code, standard output and standard error."""
    result = CliRunner().invoke(app, ["convert", *arguments])
    return result.exit_code, result.stdout, result.stderr


def test_passes_on_what_it_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    monkeypatch.setattr(model.convert, "convert_trajectron", lambda *arguments: calls.append(arguments))
    out = tmp_path / "out"
    code, stdout, _ = run("trajectron", str(tmp_path), "--checkpoint", "7", "--out", str(out))
    assert (code, stdout) == (0, f"wrote {out}\n")
    assert calls == [(tmp_path, 7, out)]


@pytest.mark.parametrize(
    "error",
    [
        UnsafePickleError("it names os.system"),
        CheckpointError(Path("x"), "a tensor is missing"),
        OSError("disk full"),
    ],
)
def test_failures_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def refuse(*arguments: object) -> None:
        raise error

    monkeypatch.setattr(model.convert, "convert_trajectron", refuse)
    assert run("trajectron", str(tmp_path), "--out", str(tmp_path / "out")) == (1, "", f"error: {error}\n")


def test_an_empty_folder(tmp_path: Path) -> None:
    code, stdout, stderr = run("trajectron", str(tmp_path), "--out", str(tmp_path / "out"))
    assert (code, stdout) == (1, "")
    assert stderr.startswith("error: ")


def test_usage(tmp_path: Path) -> None:
    assert run("alphafold", str(tmp_path), "--out", "x")[0] == 2
    assert run("trajectron", str(tmp_path / "nowhere"), "--out", "x")[0] == 2
    assert run("trajectron", str(tmp_path))[0] == 2
