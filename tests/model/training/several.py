"""One process of a run of several, for torchrun: trains a little and keeps what it ends with."""

import sys
from pathlib import Path

import torch
from safetensors.torch import save_file

from model.training import processes
from model.training.config import Method
from model.training.loop import SCORE, Trainer
from tests.model.training.fakes import MadeUpPairs, small_config


def main(folder: Path) -> None:
    """Two epochs of three steps."""
    torch.set_num_threads(1)
    device = torch.device("cpu")
    processes.join(device)
    judged = []

    def judge(_: torch.nn.Module) -> dict[str, float]:
        judged.append(processes.rank())
        return {SCORE: 1.0}

    trainer = Trainer(small_config(Method.CAB, epochs=2), MadeUpPairs(48), judge, folder / "run", device)
    trainer.run(lambda *_: None, lambda *_: None)
    assert judged == ([0, 0] if processes.rank() == 0 else [])
    save_file(dict(trainer.networks.state_dict()), folder / f"{processes.rank()}.safetensors")
    torch.distributed.destroy_process_group()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
