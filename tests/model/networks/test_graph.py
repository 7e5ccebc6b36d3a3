"""Native forwards against the networks that they were exported from."""

import pytest
import torch

from loadtest.forward import cab_network, features_in_agent_frame
from model.convert.onnx_graphs import architectures, export_graph
from model.features.spec import Frame
from model.forecaster import Context, Features
from model.networks.agent_frame import AgentFrameNetwork
from model.networks.config import BlindContext, NetworkConfig
from model.networks.forecaster import CvaeForecaster, CvaeNetworks
from model.networks.graph import GRAPHS, PARAMETERS, GraphForward, graph_name
from model.scenes.scene import AgentType

EVERYTHING = NetworkConfig(frame=Frame.AGENT, far_map=True, blind=BlindContext.NULL)
HISTORY_ALONE = NetworkConfig(frame=Frame.AGENT, neighbor_types=(), uses_map=False)


def network(config: NetworkConfig, seed: int = 0) -> AgentFrameNetwork:
    """Return a network with random parameters, larger than those that training begins with."""
    torch.manual_seed(seed)
    made = CvaeNetworks(config).of(AgentType.VEHICLE).eval().requires_grad_(False)
    assert isinstance(made, AgentFrameNetwork)
    for head in (made.refine, made.sigma, made.logits, made.mode_logits):
        head.weight.mul_(10.0)
    made.width.copy_(torch.linspace(0.8, 1.2, 12))
    made.temperature.fill_(1.7)
    return made


def some_features(agents: int) -> Features:
    """Return random features with short histories, empty places of neighbours and unknown ground."""
    features = features_in_agent_frame(agents)
    features["first"] = torch.arange(agents) % 5
    features["neighbors"][:, 7:] = 0.0
    features["far_map"][:, :, 60:] = 0.0
    return features


@pytest.mark.parametrize("context", [Context.FULL, Context.BLIND])
@pytest.mark.parametrize("agents", [1, 2, 33])
def test_a_graph_forecasts_as_its_network(agents: int, context: Context) -> None:
    eager = network(EVERYTHING)
    features = some_features(agents)
    with torch.inference_mode():
        log_weights, positions = eager(features, context, 12)
    native_weights, native = GraphForward(eager, context, 1)(features, context, 12)
    torch.testing.assert_close(native_weights.exp(), log_weights.exp(), atol=1e-4, rtol=0)
    torch.testing.assert_close(native.mean, positions.mean, atol=1e-3, rtol=0)
    sigma, native_sigma = (each.covariance.diagonal(dim1=-2, dim2=-1).sqrt() for each in (positions, native))
    torch.testing.assert_close(native_sigma, sigma, atol=1e-3, rtol=1e-4)


def test_fewer_steps_are_the_first_of_all() -> None:
    eager = network(HISTORY_ALONE)
    graph = GraphForward(eager, Context.FULL, 1)
    features = some_features(3)
    short, whole = (graph(features, Context.FULL, steps)[1] for steps in (4, 12))
    torch.testing.assert_close(short.mean, whole.mean[:, :, :4], atol=0, rtol=0)
    torch.testing.assert_close(short.covariance, whole.covariance[:, :, :4], atol=0, rtol=0)
    with pytest.raises(ValueError, match="forecasts 12 steps"):
        graph(features, Context.FULL, 13)
    with pytest.raises(ValueError, match="full context"):
        graph(features, Context.BLIND, 12)


@pytest.mark.parametrize(
    "config", [NetworkConfig(), EVERYTHING.model_copy(update={"modes": 7})], ids=["ground frame", "7 modes"]
)
def test_architectures_without_a_graph_are_told(config: NetworkConfig) -> None:
    with pytest.raises(LookupError, match="graph"):
        GraphForward(CvaeNetworks(config).of(AgentType.VEHICLE), Context.FULL, 1)


def test_a_model_of_another_history_stays_in_pytorch() -> None:
    made = cab_network(Frame.AGENT)
    assert made.compile(1)
    state = made.networks.state_dict()
    shorter = CvaeForecaster(made.info.model_copy(update={"history_frames": 3}), EVERYTHING, state)
    assert not shorter.compile(1)
    features = some_features(2)
    features["history"] = features["history"][:, :3]
    features["first"] = torch.zeros(2, dtype=torch.int64)
    assert len(shorter.forecast(features, AgentType.VEHICLE)) == 2


def test_every_architecture_that_is_exported_is_in_the_package() -> None:
    names = {graph_name(config, context) for config, context in architectures()}
    assert {file.name for file in GRAPHS.glob("*.onnx")} == names
    for name in names:
        file = GRAPHS / name
        assert file.stat().st_size < 200_000  # operations only
        assert file.with_suffix(PARAMETERS).is_file()


@pytest.mark.filterwarnings("ignore")  # of the exporter's dependencies
def test_an_export_is_what_the_package_holds() -> None:
    model, names = export_graph(HISTORY_ALONE, Context.FULL)
    file = GRAPHS / graph_name(HISTORY_ALONE, Context.FULL)
    assert names == file.with_suffix(PARAMETERS).read_text().split()
    assert [node.op_type for node in model.graph.node] == _operations(file.read_bytes())


def _operations(encoded: bytes) -> list[str]:
    import onnx

    return [node.op_type for node in onnx.load_model_from_string(encoded).graph.node]
