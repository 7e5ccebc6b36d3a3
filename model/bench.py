"""How fast the forward is, against what this process's matrix products reach: ``make bench``.

Rates and times are of one process in one run; on a busy machine only their ratio means much.
"""

import platform
import time
from collections.abc import Callable
from functools import partial
from statistics import median

import torch
from rich.console import Console
from rich.table import Table

from model.cvae import CvaeForecaster, CvaeNetworks
from model.forecaster import Context, Features, ModelInfo, Protocol
from model.networks.config import BlindContext, NetworkConfig
from model.scene import AgentType

AGENTS = (1, 8, 32, 128)
FLOP_PER_AGENT = 42e6
"""Multiplications and additions of the full forward, K = 25, T = 12 (REFERENCE, section 2)."""
HISTORY_FRAMES = 5
_SECONDS_EACH = 2.0
_LEAST_CALLS = 11
_MATRIX = 1024


def paired_seconds(*calls: Callable[[], object], seconds: float = _SECONDS_EACH) -> list[float]:
    """Median time of each call, taken in turns over ``seconds``, after a warm-up of a tenth of that.

    In turns, so that what else the machine does meets them alike and their ratio holds.
    """
    times: list[list[float]] = [[] for _ in calls]
    begin = time.perf_counter()
    while time.perf_counter() < begin + 1.1 * seconds or len(times[0]) < _LEAST_CALLS:
        for call, own in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            own.append(time.perf_counter() - start)
    return [median(own[len(own) // 11 :]) for own in times]


def cab_network() -> CvaeForecaster:
    """A CAB network for vehicles with seeded random weights: speed does not hang on their values."""
    torch.manual_seed(0)
    config = NetworkConfig(blind=BlindContext.NULL)
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
    """Random features of that many vehicles."""
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


def main() -> None:
    """Prints the table."""
    model = cab_network()
    left, right = torch.randn(_MATRIX, _MATRIX), torch.randn(_MATRIX, _MATRIX)
    table = Table(
        title=f"full forward, K = {model.info.modes}, T = {model.info.steps}, "
        f"{FLOP_PER_AGENT / 1e6:.0f} MFLOP an agent; {torch.get_num_threads()} threads, "
        f"torch {torch.__version__}, {platform.machine()}"
    )
    for heading in ("vehicles", "ms", "agents/s", "fp32 matmul, GFLOP/s", "share of matmul rate"):
        table.add_column(heading, justify="right")
    for agents in AGENTS:
        batch = features(agents)
        forward = partial(model.forecast, batch, AgentType.VEHICLE, Context.FULL)
        seconds, product = paired_seconds(forward, partial(torch.matmul, left, right))
        rate = 2 * _MATRIX**3 / product
        share = agents * FLOP_PER_AGENT / seconds / rate
        table.add_row(
            str(agents),
            f"{1e3 * seconds:.1f}",
            f"{agents / seconds:.0f}",
            f"{rate / 1e9:.0f}",
            f"{share:.2f}",
        )
    Console().print(table)


if __name__ == "__main__":
    main()
