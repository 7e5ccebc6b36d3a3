"""One process of a run of several, for torchrun: trains a little and keeps what it ends with."""

import sys
import time
from pathlib import Path

import torch
from safetensors.torch import save_file

from model.training import processes
from model.training.config import Method, TrainingError
from model.training.loop import SCORE, Trainer
from tests.model.training.fakes import MadeUpPairs, small_config


def main(folder: Path, score: float) -> None:
    """Train for two epochs of three steps; the error that ends it is written beside the run.

    Args:
        folder: where everything goes.
        score: score of each epoch; NaN: the run diverges in the first one.
    """
    torch.set_num_threads(1)
    device = torch.device("cpu")
    processes.join(device)
    evaluated = []

    def evaluate(_: torch.nn.Module) -> dict[str, float]:
        evaluated.append(processes.rank())
        return {SCORE: score}

    trainer = Trainer(small_config(Method.CAB, epochs=2), MadeUpPairs(48), evaluate, folder / "run", device)
    try:
        trainer.run(lambda *_: None, lambda *_: None)
    except TrainingError as error:
        (folder / f"{processes.rank()}.error").write_text(str(error))
        # Stays, as a process does that still writes its log: the others have to end by themselves
        time.sleep(5)
    else:
        assert evaluated == ([0, 0] if processes.rank() == 0 else [])
    save_file(dict(trainer.networks.state_dict()), folder / f"{processes.rank()}.safetensors")
    torch.distributed.destroy_process_group()


if __name__ == "__main__":
    main(Path(sys.argv[1]), float(sys.argv[2]))
