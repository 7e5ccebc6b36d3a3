"""Export of networks of the agent's frame to the ONNX graphs that the server runs.

A graph holds operations only: every parameter is an external initializer, which a checkpoint fills
(``model.networks.graph``). So there is one graph for each architecture, and it ships with the package.

Run ``python -m model.convert.onnx_graphs`` after a change of ``model.networks.agent_frame``. The tests
compare each graph with the network itself.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import onnx
import torch
from torch import Tensor, nn

from model.features.spec import Frame
from model.forecaster import Context
from model.networks.agent_frame import STEPS, AgentFrameNetwork
from model.networks.config import NetworkConfig
from model.networks.graph import GRAPHS, OUTPUTS, PARAMETERS, PREFIX, WEIGHTS, graph_inputs, graph_name

_AGENTS = 8
_MAX_AGENTS = 65536


class _Forward(nn.Module):
    """A network's forward in one context, with tensors in and out."""

    def __init__(self, network: AgentFrameNetwork, context: Context, names: tuple[str, ...]) -> None:
        super().__init__()
        self.network = network
        self._context = context
        self._names = names

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return log-weights, means and covariances."""
        features = dict(zip(self._names, inputs, strict=True))
        log_weights, positions = self.network(features, self._context, STEPS)
        return log_weights, positions.mean, positions.covariance


def architectures() -> Iterator[tuple[NetworkConfig, Context]]:
    """Yield the architectures and contexts that have a graph."""
    everything = NetworkConfig(frame=Frame.AGENT, far_map=True)
    nothing = NetworkConfig(frame=Frame.AGENT, neighbor_types=(), uses_map=False)
    yield everything, Context.FULL
    yield everything, Context.BLIND
    yield nothing, Context.FULL


def export_graph(config: NetworkConfig, context: Context) -> tuple[onnx.ModelProto, list[str]]:
    """Return the graph of a network's forward, with all parameters external, and their names.

    Args:
        config: the architecture, in the agent's frame.
        context: full or blind.
    """
    network = AgentFrameNetwork(config).eval()
    inputs = graph_inputs(config, context)
    names = tuple(inputs)
    agents = torch.export.Dim("agents", min=1, max=_MAX_AGENTS)
    exported = torch.export.export(
        _Forward(network, context, names),
        tuple(torch.zeros(_AGENTS, *shape, dtype=dtype) for shape, dtype in inputs.values()),
        dynamic_shapes={"inputs": tuple({0: agents} for _ in names)},
    )
    table: dict[Any, Any] = dict(torch.export.default_decompositions())
    # ONNX has no hypot
    table[torch.ops.aten.hypot.default] = lambda x, y: (x * x + y * y).sqrt()
    exported = exported.run_decompositions(table)
    program = torch.onnx.export(
        exported,
        dynamo=True,
        optimize=False,
        input_names=list(names),
        output_names=list(OUTPUTS),
        verbose=False,
    )
    assert program is not None  # noqa: S101 (for the type checker: it is None only when written to a file)
    model: onnx.ModelProto = program.model_proto
    _strip(model)
    return model, _externalize(model, network.state_dict())


def _strip(model: onnx.ModelProto) -> None:
    """Remove source locations and other remarks, which are most of the size."""
    del model.metadata_props[:]
    for node in [*model.graph.node, *(n for function in model.functions for n in function.node)]:
        del node.metadata_props[:]
        node.ClearField("doc_string")
    for value in [*model.graph.input, *model.graph.output]:
        del value.metadata_props[:]
        value.ClearField("doc_string")
    for initializer in model.graph.initializer:
        del initializer.metadata_props[:]
        initializer.ClearField("doc_string")
    del model.graph.value_info[:]
    del model.graph.metadata_props[:]


def _externalize(model: onnx.ModelProto, parameters: Mapping[str, Tensor]) -> list[str]:
    """Replace the parameters' values by references, and return the names of those that the graph uses."""
    names = []
    for initializer in model.graph.initializer:
        parameter = parameters.get(initializer.name.removeprefix(PREFIX))
        if parameter is None:
            continue
        names.append(initializer.name)
        for field in ("raw_data", "float_data"):
            initializer.ClearField(field)
        initializer.data_location = onnx.TensorProto.EXTERNAL
        reference = {"location": WEIGHTS, "offset": "0", "length": str(4 * parameter.numel())}
        for key, value in reference.items():
            initializer.external_data.add(key=key, value=value)
    return sorted(names)


def main() -> None:
    """Write all graphs into the package."""
    for config, context in architectures():
        model, names = export_graph(config, context)
        file = GRAPHS / graph_name(config, context)
        file.write_bytes(model.SerializeToString(deterministic=True))
        file.with_suffix(PARAMETERS).write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
        print(f"{file.name}: {file.stat().st_size / 1e3:.0f} kB")  # noqa: T201


if __name__ == "__main__":
    main()
