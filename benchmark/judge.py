"""All answers of a run, judged: scenes side by side in several processes."""

import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmark import BenchmarkError
from benchmark.answers import CallTimes
from benchmark.consistency import METRICS
from benchmark.hard import hardest_fde
from benchmark.models import KALMAN, learned, oldest_first, protocol_of
from benchmark.plan import PlannedScene
from benchmark.results import PER_INSTANCE, Latency, ModelResult
from benchmark.score import Judging, SceneScore, judge_scene
from cab.forecast.v1.model_service_pb2 import Model
from model.arrays import Floats
from model.metrics.aggregate import MetricMeans
from model.metrics.oracle import ORACLE

_FDE = "fde_ml_6s_m"


@dataclass
class _Sums:
    """What is known of one model so far."""

    pairs: int
    means: MetricMeans = field(default_factory=MetricMeans)
    instants: MetricMeans = field(default_factory=MetricMeans)
    statuses: Counter[str] = field(default_factory=Counter)
    lost: int = 0
    times: list[CallTimes] = field(default_factory=list)
    each: dict[str, Floats] = field(default_factory=dict)

    def add(self, score: SceneScore) -> None:
        self.means.add(score.metrics)
        self.instants.add(score.instants)
        self.statuses.update(score.statuses)
        self.lost += score.lost
        if score.times is not None:
            self.times.append(score.times)
        for name in PER_INSTANCE:
            if name in score.metrics:
                values = self.each.setdefault(name, np.full(self.pairs, np.nan))
                values[score.instances] = score.metrics[name]


@dataclass(frozen=True)
class Judged:
    """What all answers are worth."""

    models: tuple[ModelResult, ...]
    """In the order asked for; the physics oracle after them."""
    each: Mapping[str, Floats]
    """[pairs] by ``<name@version>/<figure>``, NaN where there is no forecast: ``results.PER_INSTANCE``."""
    mismatch_m: Floats | None
    """[pairs], m, FDE at 6 s of the Kalman filter; None: it was not asked."""


def judge(
    folder: Path,
    scenes: Sequence[PlannedScene],
    models: Mapping[str, Model],
    judging: Judging,
    processes: int,
    tick: Callable[[int], None] = lambda pairs: None,
) -> Judged:
    """Judges the answers of an archive.

    The figures do not hang on the order of the scenes, or on how many processes there are.

    Args:
        folder: of the archive.
        scenes: what was asked.
        models: by ``name@version``.
        judging: how.
        processes: that judge; 1: this one alone.
        tick: told of each scene how many pairs it has.
    """
    pairs = sum(len(scene.pairs) for scene in scenes)
    sums: dict[str, _Sums] = {key: _Sums(pairs) for key in models}
    for scene, scores in _scores(folder, scenes, list(models), judging, processes):
        for key, score in scores.items():
            sums.setdefault(key, _Sums(pairs)).add(score)
        tick(len(scene.pairs))
    ranking = [key for key in oldest_first(models) if _is_kalman(key)]
    kalman = [sums[key].each[_FDE] for key in ranking if _FDE in sums[key].each]
    mismatch_m = kalman[-1] if kalman else None
    each = {f"{key}/{name}": values for key, known in sums.items() for name, values in known.each.items()}
    results = tuple(_result(key, models.get(key), known, mismatch_m) for key, known in sums.items())
    return Judged(results, each, mismatch_m)


def _scores(
    folder: Path, scenes: Sequence[PlannedScene], models: Sequence[str], judging: Judging, processes: int
) -> Iterator[tuple[PlannedScene, dict[str, SceneScore]]]:
    if processes == 1:
        for scene in scenes:
            yield scene, judge_scene(folder, scene, models, judging)
        return
    # Spawned: a fork would copy threads of torch and gRPC in whatever state they are
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(scenes)), mp_context=context) as pool:
        # The longest first, so that no process is left with one at the end
        ordered = sorted(scenes, key=lambda scene: -scene.forecasts)
        work = {pool.submit(judge_scene, folder, scene, models, judging): scene for scene in ordered}
        try:
            for done in as_completed(work):
                yield work[done], done.result()
        except BrokenProcessPool as error:
            raise BenchmarkError(f"a judging process died, for want of memory? {error}") from error
        finally:
            pool.shutdown(cancel_futures=True)


def _result(key: str, model: Model | None, known: _Sums, mismatch_m: Floats | None) -> ModelResult:
    metrics = known.means.figures() | known.instants.means()
    if mismatch_m is not None and _FDE in known.each:
        metrics |= hardest_fde(known.each[_FDE], mismatch_m)
    instants = known.instants.count(METRICS[0]) if METRICS[0] in known.instants.names() else 0
    if model is None:
        return ModelResult(ORACLE, "", "any", "", {}, metrics, instants)
    return ModelResult(
        model.name,
        model.version,
        protocol_of(model).value if learned(model) else "any",
        model.trained_on,
        dict(sorted(known.statuses.items())),
        metrics,
        instants,
        known.lost,
        _latency(known.times),
    )


def _latency(times: Sequence[CallTimes]) -> Latency | None:
    seconds = np.concatenate([np.zeros(0), *(one.seconds for one in times)])
    if not len(seconds):
        return None
    p50, p90, p99 = np.quantile(seconds, (0.5, 0.9, 0.99)).tolist()
    return Latency(
        calls=len(seconds),
        p50_s=p50,
        p90_s=p90,
        p99_s=p99,
        queue_p50_s=float(np.median(np.concatenate([one.queue_seconds for one in times]))),
        inference_p50_s=float(np.median(np.concatenate([one.inference_seconds for one in times]))),
        batch_agents_mean=float(np.concatenate([one.batch_agents for one in times]).mean()),
    )


def _is_kalman(key: str) -> bool:
    return key.partition("@")[0] == KALMAN
