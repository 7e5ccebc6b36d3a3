"""Runs of several processes."""

import subprocess
import sys
from pathlib import Path

import torch
from safetensors.torch import load_file

from model.networks.config import BlindContext, NetworkConfig
from model.networks.forecaster import CvaeNetworks
from model.training import processes


def test_a_run_without_torchrun_is_one_process() -> None:
    assert processes.join(torch.device("cpu"))
    assert (processes.rank(), processes.world()) == (0, 1)


def test_two_processes_learn_the_same(tmp_path: Path) -> None:
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    script = [str(Path(__file__).with_name("several.py")), str(tmp_path)]
    done = subprocess.run(  # noqa: S603 (our own)
        [*torchrun, *script], capture_output=True, text=True, timeout=300, check=False, cwd=Path.cwd()
    )
    assert done.returncode == 0, done.stderr
    first, second = (load_file(tmp_path / f"{rank}.safetensors") for rank in (0, 1))
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
    torch.manual_seed(0)
    name = "vehicle.full.decoder.mean.weight"
    assert not torch.equal(
        CvaeNetworks(NetworkConfig(blind=BlindContext.NULL, modes=5)).state_dict()[name], first[name]
    )
    assert (tmp_path / "run/state.json").is_file()
