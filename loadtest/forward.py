"""Speed of the forward pass, relative to this process's matrix products: ``make bench``.

The times are from one process in one run. On a busy machine only the ratio is meaningful.
"""

import platform
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import torch
from rich.console import Console
from rich.table import Table

from model.features.agent_features import NEIGHBOR_FEATURES, NEIGHBORS
from model.features.spec import Frame
from model.forecaster import Context, Features, ModelInfo, Protocol
from model.networks.config import BlindContext, NetworkConfig
from model.networks.forecaster import CvaeForecaster, CvaeNetworks
from model.networks.graph import HISTORY_FRAMES
from model.scenes.scene import AgentType

AGENTS = (1, 8, 32, 128)
FLOP_PER_AGENT = {Frame.GROUND: 42e6, Frame.AGENT: 25e6}
"""Multiplications and additions of the full forward pass, K = 25, T = 12: of the published network with its
GRU unrolled (REFERENCE, section 2), and of the network in the agent's frame."""
_SECONDS_EACH = 2.0
_MIN_CALLS = 11
_MATRIX = 1024


def paired_seconds(*calls: Callable[[], object], seconds: float = _SECONDS_EACH) -> list[float]:
    """Return the median time of each call after a warm-up of a tenth of ``seconds``.

    The calls alternate, so that other load on the machine affects them equally and their ratio holds.
    """
    times: list[list[float]] = [[] for _ in calls]
    begin = time.perf_counter()
    while time.perf_counter() < begin + 1.1 * seconds or len(times[0]) < _MIN_CALLS:
        for call, own in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            own.append(time.perf_counter() - start)
    return [median(own[len(own) // 11 :]) for own in times]


def cab_network(frame: Frame = Frame.GROUND) -> CvaeForecaster:
    """Return a CAB network for vehicles with seeded random weights; the speed does not depend on them."""
    torch.manual_seed(0)
    config = NetworkConfig(blind=BlindContext.NULL, frame=frame, far_map=frame is Frame.AGENT)
    info = ModelInfo(
        name="cab",
        version="0",
        protocol=Protocol.CAUSAL,
        description="random weights, for measuring speed",
        agent_types=config.agent_types,
        context_types=config.neighbor_types,
        history_frames=HISTORY_FRAMES,
        modes=config.modes,
        uses_map=True,
        uses_neighbors=True,
        supports_blind=True,
        license="none",
    )
    return CvaeForecaster(info, config, CvaeNetworks(config).state_dict())


def features(agents: int) -> Features:
    """Return random features of that many vehicles for a network in the ground frame."""
    generator = torch.Generator().manual_seed(agents)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(agents, *shape, generator=generator)

    return {
        "origin": normal(2).double(),
        "velocity": 5 * normal(2),
        "history": normal(HISTORY_FRAMES, 8),
        "first": torch.zeros(agents, dtype=torch.long),
        "neighbors.vehicle": normal(HISTORY_FRAMES, 8),
        "neighbors.pedestrian": normal(HISTORY_FRAMES, 6),
        "edge_mask": torch.ones(agents),
        "map": (normal(3, 100, 100) > 0).float() * 2 - 1,
    }


def features_in_agent_frame(agents: int) -> Features:
    """Return random features of that many vehicles for a network in the agent's frame."""
    generator = torch.Generator().manual_seed(agents)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(agents, *shape, generator=generator)

    neighbors = normal(NEIGHBORS, NEIGHBOR_FEATURES)
    neighbors[..., -1] = 1.0
    return {
        "origin": normal(2).double(),
        "heading": normal(1)[:, 0].double(),
        "speed": 5 * normal(1)[:, 0].abs(),
        "history": normal(HISTORY_FRAMES, 8),
        "first": torch.zeros(agents, dtype=torch.long),
        "neighbors": neighbors,
        "map": (normal(3, 100, 100) > 0).float() * 2 - 1,
        "far_map": (normal(3, 100, 100) > 0).float() * 2 - 1,
    }


def main() -> None:
    """Print the table; the networks alternate, so that other load on the machine affects them equally."""
    served = cab_network(Frame.AGENT)
    if not served.compile(torch.get_num_threads()):
        raise RuntimeError("the network in the agent's frame has no graph")
    models = (
        ("ground", Frame.GROUND, cab_network(Frame.GROUND)),
        ("agent", Frame.AGENT, cab_network(Frame.AGENT)),
        ("agent, ONNX", Frame.AGENT, served),
    )
    left, right = torch.randn(_MATRIX, _MATRIX), torch.randn(_MATRIX, _MATRIX)
    table = Table(
        title=f"full forward, K = {served.info.modes}, T = {served.info.steps}; "
        f"{torch.get_num_threads()} threads, torch {torch.__version__}, {platform.machine()}"
    )
    for column in (
        "vehicles",
        "network",
        "ms",
        "agents/s",
        "fp32 matmul, GFLOP/s",
        "share of matmul rate",
    ):
        table.add_column(column, justify="right")
    for agents in AGENTS:
        batches = {Frame.GROUND: features(agents), Frame.AGENT: features_in_agent_frame(agents)}
        forwards = [
            partial(model.forecast, batches[frame], AgentType.VEHICLE, Context.FULL)
            for _, frame, model in models
        ]
        *seconds, product = paired_seconds(*forwards, partial(torch.matmul, left, right))
        rate = 2 * _MATRIX**3 / product
        for (label, frame, _), one in zip(models, seconds, strict=True):
            share = agents * FLOP_PER_AGENT[frame] / one / rate
            table.add_row(
                str(agents),
                label,
                f"{1e3 * one:.1f}",
                f"{agents / one:.0f}",
                f"{rate / 1e9:.0f}",
                f"{share:.2f}",
            )
    Console().print(table)


if __name__ == "__main__":
    main()
