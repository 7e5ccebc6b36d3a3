"""Runs of several processes."""

import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from model.networks.config import BlindContext, NetworkConfig
from model.networks.forecaster import CvaeNetworks
from model.training import processes


def test_a_run_without_torchrun_is_one_process() -> None:
    assert processes.join(torch.device("cpu"))
    assert (processes.rank(), processes.world()) == (0, 1)


def run_two(folder: Path, score: float, timeout: float) -> None:
    """Run ``several.py`` in two processes."""
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    script = [str(Path(__file__).with_name("several.py")), str(folder), str(score)]
    done = subprocess.run(  # noqa: S603 (our own)
        [*torchrun, *script], capture_output=True, text=True, timeout=timeout, check=False, cwd=Path.cwd()
    )
    assert done.returncode == 0, done.stderr


def test_the_others_end_when_the_first_process_finds_that_the_run_diverges(tmp_path: Path) -> None:
    run_two(tmp_path, math.nan, timeout=120)
    first, second = ((tmp_path / f"{rank}.error").read_text() for rank in (0, 1))
    assert "the run has diverged: after epoch 1" in first
    assert "the first process failed" in second
    assert not (tmp_path / "run/state.json").exists()


def test_an_error_of_the_first_process_alone_is_its_own() -> None:
    def fail() -> None:
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space left"):
        processes.only_first(fail)
    with pytest.raises(OSError, match="no space left"):
        processes.first_then_others(fail)
    assert processes.only_first(lambda: 3) == processes.first_then_others(lambda: 3) == 3


def test_two_processes_learn_the_same(tmp_path: Path) -> None:
    run_two(tmp_path, 1.0, timeout=300)
    first, second = (load_file(tmp_path / f"{rank}.safetensors") for rank in (0, 1))
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
    torch.manual_seed(0)
    name = "vehicle.full.decoder.mean.weight"
    assert not torch.equal(
        CvaeNetworks(NetworkConfig(blind=BlindContext.NULL, modes=5)).state_dict()[name], first[name]
    )
    assert (tmp_path / "run/state.json").is_file()
