"""The forward of a network of the agent's frame as one native call (ONNX Runtime).

It holds no lock of the interpreter while it runs, and its threads wait passively, so it keeps its speed
beside busy neighbours. The graphs ship with the package and hold operations only
(``model.convert.onnx_graphs`` makes them); parameters come from the checkpoint. Nothing is executed that a
checkpoint brings.
"""

import os
from pathlib import Path
from typing import Final

# ONNX Runtime's official builds report their use to Microsoft unless this is set before they are loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime
import torch
from torch import nn

from model.features.agent_features import NEIGHBOR_FEATURES, NEIGHBORS
from model.features.standardization import STATE_SIZE
from model.forecaster import Context, Features
from model.networks.agent_frame import STEPS, AgentFrameNetwork
from model.networks.config import NetworkConfig
from model.networks.dynamics import Positions
from model.scenes.raster import FAR, NEAR
from model.scenes.scene import AgentType

GRAPHS: Final = Path(__file__).parent / "graphs"
"""The folder of the graphs."""
WEIGHTS: Final = "parameters"
"""The file that parameters refer to; there is none, they are given in memory."""
OUTPUTS: Final = ("log_weights", "means", "covariances")
HISTORY_FRAMES: Final = 5
"""F, frames of history that graphs take."""
PREFIX: Final = "network."
"""Prefix of the parameters' names in a graph."""
PARAMETERS: Final = ".parameters"
"""Suffix of the file beside a graph that names its parameters, one a line."""

onnxruntime.set_default_logger_severity(3)  # errors only: it warns of constants that it leaves unfolded


def graph_inputs(config: NetworkConfig, context: Context) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
    """Return the features that a graph takes, in order: the shape of one agent's and the type."""
    inputs: dict[str, tuple[tuple[int, ...], torch.dtype]] = {
        "heading": ((), torch.float64),
        "speed": ((), torch.float32),
        "history": ((HISTORY_FRAMES, STATE_SIZE[AgentType.VEHICLE]), torch.float32),
        "first": ((), torch.int64),
    }
    if context is Context.FULL:
        if config.neighbor_types:
            inputs["neighbors"] = ((NEIGHBORS, NEIGHBOR_FEATURES), torch.float32)
        if config.uses_map:
            inputs["map"] = ((3, NEAR.size, NEAR.size), torch.float32)
        if config.far_map:
            inputs["far_map"] = ((3, FAR.size, FAR.size), torch.float32)
    return inputs


def graph_name(config: NetworkConfig, context: Context) -> str:
    """Return the file name of the graph of an architecture."""
    seen = [
        "neighbors" if config.neighbor_types else "",
        "map" if config.uses_map else "",
        "far_map" if config.far_map else "",
    ]
    floor = "-".join(f"{value:g}" for value in config.min_sigma_m)
    sees = "-".join(one for one in seen if one) or "history"
    return f"vehicle-{sees}-{config.modes}-{floor}-{context.value}.onnx"


class GraphForward:
    """A network's forward in ONNX Runtime.

    Args:
        network: the network, whose parameters it runs with; the memory is shared.
        context: full or blind.
        threads: threads of one forward.

    Raises:
        LookupError: there is no graph of that architecture.
    """

    def __init__(self, network: nn.Module, context: Context, threads: int) -> None:
        if not isinstance(network, AgentFrameNetwork):
            raise LookupError("only networks of the agent's frame have graphs")
        self._context = context
        network, seen = network.branch(context)
        file = GRAPHS / graph_name(network.config, seen)
        if not file.is_file():
            raise LookupError(f"there is no graph {file.name}")
        self._inputs = tuple(graph_inputs(network.config, seen))
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        parameters = network.state_dict()
        # The session reads the parameters in place, so they must live as long as it does
        self._parameters = {
            name: onnxruntime.OrtValue.ortvalue_from_numpy(
                parameters[name.removeprefix(PREFIX)].contiguous().numpy()
            )
            for name in file.with_suffix(PARAMETERS).read_text(encoding="utf-8").split()
        }
        options.add_external_initializers(list(self._parameters), list(self._parameters.values()))
        self._session = onnxruntime.InferenceSession(
            file.read_bytes(), options, providers=["CPUExecutionProvider"]
        )

    def __call__(self, features: Features, context: Context, steps: int) -> tuple[torch.Tensor, Positions]:
        """Return log-weights [N, K] and positions relative to now, as the network does.

        Args:
            features: the features of N agents.
            context: the graph's.
            steps: T, at most 12.

        Raises:
            ValueError: the graph is of another context, or has fewer steps.
        """
        if context is not self._context or steps > STEPS:
            raise ValueError(f"this graph forecasts {STEPS} steps with {self._context.value} context")
        given = {name: features[name].contiguous().numpy() for name in self._inputs}
        log_weights, means, covariances = map(torch.from_numpy, self._session.run(OUTPUTS, given))
        if steps != STEPS:
            means, covariances = means[:, :, :steps], covariances[:, :, :steps]
        return log_weights, Positions(means, covariances)
