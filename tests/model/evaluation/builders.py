"""Checkpoints and results for the tests of evaluation."""

from pathlib import Path

import torch

from model.checkpoint import save_checkpoint
from model.evaluation.results import EvaluationModelResult, EvaluationResults
from model.forecaster import Protocol
from model.networks.config import BlindContext, CoverNetConfig, NetworkConfig
from model.networks.forecaster import CoverNetworks
from tests.model.checkpoints import info, tensors

FULL = NetworkConfig(blind=BlindContext.NULL, modes=3)
ALONE = NetworkConfig(neighbor_types=(), uses_map=False, modes=3)
PAPER_VERSION = "1.0.0+paper"


def save(folder: Path, name: str, config: NetworkConfig = FULL, version: str = "1.0.0") -> None:
    """A checkpoint of random weights; its version tells the protocol."""
    protocol = Protocol.PAPER if version == PAPER_VERSION else Protocol.CAUSAL
    save_checkpoint(folder, info(config, name, version, protocol), config, tensors(config), "")


def save_covernet(folder: Path) -> None:
    """A CoverNet of random weights, which sees its neighbours as boxes."""
    config = CoverNetConfig(members=9, modes=3)
    generator = torch.Generator().manual_seed(0)
    shapes = CoverNetworks(config).state_dict()
    drawn = {name: 0.1 * torch.randn(shape.shape, generator=generator) for name, shape in shapes.items()}
    drawn = {name: tensor.abs() if name.endswith("variance") else tensor for name, tensor in drawn.items()}
    save_checkpoint(folder, info(config, "covernet"), config, drawn, "")


def checkpoints(folder: Path) -> Path:
    """A folder as the bundled one is: cab and trajectron-no-context, and cab of the paper protocol."""
    save(folder / "cab", "cab")
    save(folder / "cab-paper", "cab", version=PAPER_VERSION)
    save(folder / "trajectron-no-context", "trajectron-no-context", ALONE)
    return folder


def row(name: str, learned: bool = True, version: str = "1.0.0", **figures: float) -> EvaluationModelResult:
    """A model with few figures."""
    return EvaluationModelResult(name=name, version=version, learned=learned, trained_on="", metrics=figures)


def results(*rows: EvaluationModelResult, ablate: bool = False, samples: int = 200) -> EvaluationResults:
    """Results on ten pairs."""
    return EvaluationResults(
        data="made",
        split="some",
        protocol=Protocol.CAUSAL,
        pairs=10,
        limit=None,
        samples=samples,
        draws=199,
        ablate=ablate,
        models=rows,
    )
