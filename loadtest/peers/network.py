"""The network behind each peer, and the options that its process gets."""

import argparse
from dataclasses import dataclass
from pathlib import Path

import torch

from loadtest.peers.arrays import Arrays, from_mixture, join, split, to_features
from model.features.spec import Frame
from model.forecaster import Context
from model.networks.config import NetworkConfig
from model.networks.forecaster import CvaeForecaster
from model.networks.graph import graph_inputs
from model.registry import Registry
from model.scenes.scene import AgentType

HOST = "127.0.0.1"
MAX_CALLS = 16
"""Calls that a peer may join to one batch, where it can."""
MAX_AGENTS = 128
"""Max number of agents of a forward; beyond it, larger batches are not faster."""


@dataclass(frozen=True)
class ServedModel:
    """The model that a peer serves, and where."""

    port: int
    models: Path
    """Folder of checkpoints."""
    model: str
    engine: str
    """onnxruntime or eager."""
    threads: int | None
    """Threads of a forward; None: all cores."""

    @property
    def flags(self) -> list[str]:
        """Flags that ``from_flags`` reads."""
        threads = [] if self.threads is None else ["--threads", str(self.threads)]
        flags = ["--port", str(self.port), "--models", str(self.models), "--model", self.model]
        return [*flags, "--engine", self.engine, *threads]

    @classmethod
    def from_flags(cls, arguments: list[str] | None = None) -> "ServedModel":
        """Return what the command line says.

        Args:
            arguments: the flags; None: those of this process.
        """
        parser = argparse.ArgumentParser()
        parser.add_argument("--port", type=int, required=True)
        parser.add_argument("--models", type=Path, required=True)
        parser.add_argument("--model", default="cab")
        parser.add_argument("--engine", choices=["onnxruntime", "eager"], default="onnxruntime")
        parser.add_argument("--threads", type=int)
        return cls(**vars(parser.parse_args(arguments)))


class Network:
    """The network, called with prepared tensors of vehicles. Not thread-safe in its use of all cores.

    Args:
        served: the model.

    Raises:
        RuntimeError: the model cannot run in the engine.
    """

    def __init__(self, served: ServedModel) -> None:
        self._forecaster = Registry.load(served.models).get(served.model)
        if served.engine == "eager":
            if served.threads is not None:
                torch.set_num_threads(served.threads)
        elif self._forecaster.compile(served.threads or torch.get_num_threads()):
            torch.set_num_threads(
                1
            )  # the few operations beside the forward would start a team for each thread
        else:
            raise RuntimeError(f"{served.model} has no forward in {served.engine}")

    @property
    def inputs(self) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
        """Features that the network takes: the shape of one agent's and the type.

        Raises:
            TypeError: the network is not one of the agent's frame.
        """
        config = self._forecaster.config if isinstance(self._forecaster, CvaeForecaster) else None
        if not isinstance(config, NetworkConfig) or config.frame is not Frame.AGENT:
            raise TypeError(f"{self._forecaster.info.name} is no network of the agent's frame")
        return {"origin": ((2,), torch.float64), **graph_inputs(config, Context.FULL)}

    def __call__(self, arrays: Arrays) -> Arrays:
        """Return the forecasts of the agents of one call, or of several that were joined."""
        return from_mixture(self._forecaster.forecast(to_features(arrays), AgentType.VEHICLE))

    def batch(self, calls: list[Arrays]) -> list[Arrays]:
        """Return the forecasts of several calls, in as few forwards of up to ``MAX_AGENTS`` as possible."""
        counts = [len(call["origin"]) for call in calls]
        answers: list[Arrays] = []
        first = 0
        for index in range(len(calls)):
            if index + 1 < len(calls) and sum(counts[first : index + 2]) <= MAX_AGENTS:
                continue
            answers += split(self(join(calls[first : index + 1])), counts[first : index + 1])
            first = index + 1
        return answers
