"""Results and hard cases of few numbers, for the tests of tables, comparisons and reports."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchmark.hard_cases import CaseForecast, HardCase
from benchmark.models import BASELINES
from benchmark.results import BenchmarkModelResult, BenchmarkResults, ContextRun, Estimate, Latency
from model.forecaster import Protocol
from model.metrics.consistency import RANGES_M
from model.metrics.evaluate import MOVING, MOVING_FIGURES
from model.scenes.scene import Raster

NAMES = (
    "cab",
    "covernet",
    "halentnet",
    "halentnet-no-context",
    "reweight",
    "rubiz",
    "trajectron",
    "trajectron-no-context",
    "constant-acceleration-yaw",
    "constant-acceleration-yaw-rate",
    "constant-speed-yaw-rate",
    "constant-velocity-yaw",
    "kalman",
)
"""Names of all models that an endpoint serves."""
LATENCY = Latency(
    calls=40,
    p50_s=0.0123,
    p90_s=0.0345,
    p99_s=0.0987,
    queue_p50_s=0.0011,
    inference_p50_s=0.0055,
    batch_agents_mean=7.25,
)

MEASURES: dict[str, Estimate] = {
    "gain_m": Estimate(1.25, 0.5, 2.0, 10),
    "map_advantage_m": Estimate(-0.25, -0.5, 0.125, 9),
    "neighbors_advantage_m": Estimate(0.5, 0.25, 0.75, 8),
    "map_control_m": Estimate(0.0, -0.0625, 0.0625, 10),
    "map_control_size_m": Estimate(0.125, 0.0, 0.25, 10),
    "compliance": Estimate(0.75, 0.5, 1.0, 7),
}


def made_metrics(scale: float = 1.0) -> dict[str, float]:
    """All figures of a model: errors that grow with the horizon, and with ``scale``."""
    figures: dict[str, float] = {"off_road_ml": 0.125, "off_road_f": 0.25, "nll": 1.5 * scale}
    figures |= {"ade_f_6s_m": 3.5 * scale, "fde_f_6s_m": 9.0 * scale}
    for second in range(1, 7):
        figures[f"ade_ml_{second}s_m"] = 0.08 * second**2 * scale
        figures[f"fde_ml_{second}s_m"] = 0.2 * second**2 * scale
        figures[f"nll_{second}s"] = 0.5 * second * scale
        for percent in (50, 90, 99):
            figures[f"inside_{percent}_{second}s"] = percent / 100 / (1 + 0.02 * second * scale)
    for percent in (50, 90, 99):
        figures[f"inside_{percent}"] = percent / 100 / (1 + 0.07 * scale)
    for k in (1, 5, 10):
        figures |= {f"min_ade_{k}_m": 3.0 * scale / k, f"min_fde_{k}_m": 8.0 * scale / k}
        figures[f"miss_rate_{k}"] = 1 / k
    for k in (5, 10):
        figures |= {f"merged_min_ade_{k}_m": 2.0 * scale / k, f"merged_min_fde_{k}_m": 6.0 * scale / k}
        figures |= {f"merged_miss_rate_{k}": 0.5 / k, f"merged_brier_min_fde_{k}_m": 0.25 + 6.0 * scale / k}
    figures |= {"merged_modes_90": 3.25, "merged_modes_90_median": 3.0, "merged_first_weight": 0.625}
    figures |= {"ade_merged_6s_m": 2.75 * scale, "fde_merged_6s_m": 7.0 * scale}
    figures |= {f"{MOVING}{name}": 1.01 * figures[name] for name in MOVING_FIGURES if name in figures}
    figures["moving_merged_modes_90_median"] = 4.0
    figures |= {"dispersion_std_m": 2.0 * scale, "dispersion_mean_m": 3.0 * scale}
    figures["dispersion_rms_m"] = math.hypot(2.0, 3.0) * scale
    figures |= {f"convergence_{range_m:g}m_s": math.sqrt(range_m) / scale for range_m in RANGES_M}
    figures |= {f"fde_hardest_{share}_m": (16.0 - share) * scale for share in (1, 2, 3)}
    return figures | {"fde_hardest_all_m": 7.2 * scale}


def made_model(
    name: str = "cab",
    version: str = "1.0.0",
    protocol: str = "causal",
    metrics: Mapping[str, float] | None = None,
) -> BenchmarkModelResult:
    """A model of ten pairs, nine of which are OK."""
    return BenchmarkModelResult(
        name=name,
        version=version,
        protocol=protocol,
        trained_on="made",
        statuses={"OK": 9, "MISSING": 1},
        metrics=made_metrics() if metrics is None else metrics,
        instants=30,
        latency=LATENCY,
        context={"all": MEASURES, "turns after now": {"gain_m": Estimate(7.5, math.nan, math.nan, 3)}},
    )


def made_oracle() -> BenchmarkModelResult:
    """The oracle, which nobody calls."""
    oracle = made_model("physics-oracle", "", "any", made_metrics(1.1))
    return replace(oracle, latency=None, instants=0, statuses={}, context={})


def made_results(*models: BenchmarkModelResult, protocol: Protocol = Protocol.CAUSAL) -> BenchmarkResults:
    """Results on ten pairs; of cab alone, unless told otherwise."""
    return BenchmarkResults(
        data="made",
        split="some",
        protocol=protocol,
        pairs=10,
        limit=None,
        consistency=True,
        samples=200,
        draws=199,
        seed=3,
        plan="0123456789abcdef",
        endpoint="127.0.0.1:50051",
        concurrency=16,
        version="0.1.0",
        models=models or (made_model(),),
        context=ContextRun("trajectron-no-context@1.0.0", donors=2, cases=50, timed=100, seconds=12.25),
    )


def all_models() -> tuple[BenchmarkModelResult, ...]:
    """One of every name, and the oracle; each a little worse than the one before."""
    served = [
        made_model(
            name, protocol="any" if name in BASELINES else "causal", metrics=made_metrics(1 + 0.07 * i)
        )
        for i, name in enumerate(NAMES)
    ]
    return (*served, made_oracle())


def made_case(scene: str = "scene-1", models: Sequence[str] = ("cab@1.0.0",), modes: int = 5) -> HardCase:
    """An agent that turns left where the models expect it to go on."""
    generator = np.random.default_rng(len(models))
    layers = np.zeros((3, 600, 600), dtype=np.uint8)
    layers[0, 270:330] = layers[0, :, 280:320] = 1
    layers[1, :, 300], layers[2, 300] = 1, 1
    now = np.array([1100.0, 2098.0])
    ahead = np.arange(1, 13)[:, None] * np.array([4.0, 0.0])
    angle = np.linspace(0.1, math.pi / 2, 12)
    truth = now + 26.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    forecasts = {}
    for model in models:
        turn = generator.uniform(-0.02, 0.03, size=(modes, 1)) * np.arange(1, 13) ** 2
        paths = now + ahead * generator.uniform(0.3, 1.1, size=(modes, 1, 1))
        paths[..., 1] += turn * 10
        weights = np.sort(generator.dirichlet(np.ones(modes)))[::-1]
        error = float(np.hypot(*(paths[0, -1] - truth[-1])))
        forecasts[model] = CaseForecast(weights, paths, paths[0], error)
    return HardCase(
        scene=scene,
        agent="agent-7",
        frame=12,
        mismatch_m=38.25,
        raster=Raster(layers, np.array([1000.0, 2000.0]), 3.0),
        history=now + np.arange(-4, 1)[:, None] * np.array([4.0, 0.0]),
        truth=truth,
        others=now + np.array([[12.0, 6.0], [-20.0, 3.5]]),
        forecasts=forecasts,
    )
