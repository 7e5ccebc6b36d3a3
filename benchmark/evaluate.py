"""Evaluation of the saved answers of a run, scenes in parallel processes."""

import multiprocessing
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from benchmark.answers import CallTimes, SceneAnswers, read_answers
from benchmark.archive import Archive
from benchmark.bootstrap import Ratio
from benchmark.errors import BenchmarkError
from benchmark.hard_cases import hardest_fde
from benchmark.models import is_learned, oldest_first, protocol_of
from benchmark.plan import PlannedScene
from benchmark.results import FDE, PER_INSTANCE, BenchmarkModelResult, Instances, Latency
from cab.forecast.v1.model_service_pb2 import Model
from model.arrays import Floats, Ints
from model.data.checks import STEPS_AHEAD
from model.data.scenes import SceneRecord
from model.metrics.aggregate import MetricMeans
from model.metrics.consistency import (
    RANGES_M,
    complete,
    convergence_s,
    dispersion,
    errors_by_age_m,
    forecasts_by_age,
)
from model.metrics.oracle import ORACLE, PHYSICS, physics_oracle
from model.metrics.pairs import EvaluatedPairs, Sampling

CONSISTENCY = (
    "dispersion_std_m",
    "dispersion_mean_m",
    "dispersion_rms_m",
    *(f"convergence_{range_m:g}m_s" for range_m in RANGES_M),
)
"""Metrics of table 2: the paper's D in its three forms, C(τ) in seconds."""


@dataclass(frozen=True)
class SceneMetrics:
    """Metrics of one model on one scene."""

    instances: Ints
    """[n], indices of the pairs with a forecast in the split."""
    metrics: Mapping[str, Floats]
    """[n] each, by the names of ``instance_metrics``."""
    instants: Mapping[str, Floats] = field(default_factory=dict)
    """[P] each, by the names of ``CONSISTENCY``."""
    statuses: Mapping[str, int] = field(default_factory=dict)
    """Number of pairs by status."""
    lost: int = 0
    """Missing forecasts among those requested for dispersion and convergence only."""
    times: CallTimes | None = None


@dataclass(frozen=True)
class Evaluated:
    """Evaluation of all answers."""

    models: tuple[BenchmarkModelResult, ...]
    """Results in the requested order; the physics oracle last."""
    instances: Instances
    """Figures of each pair."""
    mismatch_m: Floats | None
    """[pairs], m, FDE at 6 s of the Kalman filter; None: it is not among the models."""


def evaluate(
    folder: Path,
    scenes: Sequence[PlannedScene],
    models: Mapping[str, Model],
    sampling: Sampling,
    consistency: bool,
    processes: int,
    tick: Callable[[int], None] = lambda pairs: None,
) -> Evaluated:
    """Evaluate the answers of an archive.

    The figures depend neither on the order of the scenes nor on the number of processes.

    Args:
        folder: folder of the archive.
        scenes: the planned scenes.
        models: models by ``name@version``.
        sampling: number of random draws.
        consistency: whether to compute dispersion and convergence.
        processes: number of processes; 1: this one.
        tick: called after each scene with its number of pairs.

    Raises:
        BenchmarkError: an answer does not fit its call, or a process died.
    """
    pairs = sum(len(scene.pairs) for scene in scenes)
    totals: dict[str, _Totals] = {key: _Totals(pairs, len(scenes)) for key in models}
    work = _Work(folder, tuple(models), sampling, consistency)
    for number, found in _evaluated_scenes(scenes, work, processes):
        for key, metrics in found.items():
            totals.setdefault(key, _Totals(pairs, len(scenes))).add(number, metrics)
        tick(len(scenes[number].pairs))
    each = {f"{key}/{name}": values for key, total in totals.items() for name, values in total.each.items()}
    ratios = {f"{key}/{name}": ratio for key, total in totals.items() for name, ratio in total.ratios.items()}
    numbers = np.repeat(np.arange(len(scenes)), [len(scene.pairs) for scene in scenes])
    instances = Instances(each, numbers, ratios)
    mismatch_m = instances.mismatch_m()
    results = tuple(total.result(models.get(key), mismatch_m) for key, total in totals.items())
    return Evaluated(results, instances, mismatch_m)


def evaluate_scene(
    scene: PlannedScene, answers: Mapping[str, SceneAnswers], sampling: Sampling, consistency: bool
) -> dict[str, SceneMetrics]:
    """Evaluate the answers about one scene.

    Args:
        scene: the planned scene.
        answers: answers by ``name@version``. If the four physics baselines are among them, the oracle of
            their newest versions is evaluated, too.
        sampling: number of random draws.
        consistency: whether to compute dispersion and convergence.

    Returns:
        Metrics by ``name@version``, and by the oracle's name.
    """
    pairs = scene.evaluated()
    found = {
        model: _model_metrics(scene.record, pairs, given, sampling, consistency)
        for model, given in answers.items()
    }
    by_name = {model.partition("@")[0]: answers[model] for model in oldest_first(answers)}
    if set(PHYSICS) <= by_name.keys():
        physics = {name: by_name[name] for name in PHYSICS}
        found[ORACLE] = _oracle_metrics(scene.record, pairs, physics, consistency)
    return found


def consistency_metrics(
    record: SceneRecord, most_likely: Mapping[int, tuple[Ints, Floats]]
) -> dict[str, Floats]:
    """Return dispersion and convergence of the forecasts of one scene's agents.

    Args:
        record: the scene, with the true positions.
        most_likely: by track, the frames of the forecasts [F], ascending, and these [F, T, 2], m.

    Returns:
        Each of ``CONSISTENCY`` [P], for the P instants of all tracks that have a forecast of every age.
    """
    parts: dict[str, list[Floats]] = {name: [] for name in CONSISTENCY}
    for number in sorted(most_likely):
        made_at, paths = most_likely[number]
        track = record.tracks[number]
        by_age = forecasts_by_age(made_at, paths, track.frames)
        known = complete(by_age)
        by_age, truth = by_age[known], track.position[known]
        spread = dispersion(by_age)
        parts["dispersion_std_m"].append(spread.std_m)
        parts["dispersion_mean_m"].append(spread.mean_m)
        parts["dispersion_rms_m"].append(spread.rms_m)
        errors_m = errors_by_age_m(by_age, truth)
        for range_m in RANGES_M:
            parts[f"convergence_{range_m:g}m_s"].append(convergence_s(errors_m, range_m))
    return {name: np.concatenate([np.zeros(0), *values]) for name, values in parts.items()}


@dataclass(frozen=True)
class _Work:
    """Evaluation of one scene in any process: a function that can be pickled."""

    folder: Path
    models: tuple[str, ...]
    sampling: Sampling
    consistency: bool

    def __call__(self, scene: PlannedScene) -> dict[str, SceneMetrics]:
        torch.set_num_threads(1)  # every core has a scene of its own
        with Archive(self.folder, read_only=True) as archive:
            answers = {model: read_answers(archive, model, scene) for model in self.models}
        return evaluate_scene(scene, answers, self.sampling, self.consistency)


def _evaluated_scenes(
    scenes: Sequence[PlannedScene], work: _Work, processes: int
) -> Iterator[tuple[int, dict[str, SceneMetrics]]]:
    """Yield the index of each scene, and its metrics by model."""
    if processes == 1:
        for number, scene in enumerate(scenes):
            yield number, work(scene)
        return
    # Spawned: a fork would copy threads of torch and gRPC in an arbitrary state
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(scenes)), mp_context=context) as pool:
        # The longest scenes first, so that no process is left with one at the end
        ordered = sorted(range(len(scenes)), key=lambda number: -scenes[number].forecasts)
        futures = {pool.submit(work, scenes[number]): number for number in ordered}
        try:
            for done in as_completed(futures):
                yield futures[done], done.result()
        except BrokenProcessPool as error:
            raise BenchmarkError(f"an evaluating process died, perhaps out of memory: {error}") from error
        finally:
            pool.shutdown(cancel_futures=True)


def _model_metrics(
    record: SceneRecord, pairs: EvaluatedPairs, answers: SceneAnswers, sampling: Sampling, consistency: bool
) -> SceneMetrics:
    known = pairs[answers.instances]
    found = SceneMetrics(known.numbers, {}, {}, answers.statuses, answers.lost, answers.times)
    if answers.mixture is not None:
        found = replace(found, metrics=known.metrics(answers.mixture, sampling))
    if consistency:
        found = replace(found, instants=consistency_metrics(record, answers.most_likely))
    return found


def _oracle_metrics(
    record: SceneRecord, pairs: EvaluatedPairs, physics: Mapping[str, SceneAnswers], consistency: bool
) -> SceneMetrics:
    """Return the oracle's metrics on pairs and instants that all four baselines have a forecast for."""
    rows = [one.instances for one in physics.values()]
    common = rows[0][np.logical_and.reduce([np.isin(rows[0], one) for one in rows])]
    metrics: dict[str, Floats] = {}
    if len(common):
        mixtures = {
            name: one.mixture[torch.from_numpy(np.searchsorted(one.instances, common))]
            for name, one in physics.items()
            if one.mixture is not None
        }
        metrics = pairs[common].oracle_metrics(mixtures)
    found = SceneMetrics(pairs.numbers[common], metrics)
    if consistency:
        paths = _oracle_paths(record, [one.most_likely for one in physics.values()])
        found = replace(found, instants=consistency_metrics(record, paths))
    return found


def _oracle_paths(
    record: SceneRecord, most_likely: Sequence[Mapping[int, tuple[Ints, Floats]]]
) -> dict[int, tuple[Ints, Floats]]:
    """Return the oracle's trajectories at every frame, as ``SceneAnswers.most_likely``."""
    paths = {}
    for track in set.intersection(*(set(one) for one in most_likely)):
        made = [one[track] for one in most_likely]
        frames = made[0][0][np.logical_and.reduce([np.isin(made[0][0], frames) for frames, _ in made])]
        forecasts = np.stack([path[np.searchsorted(own, frames)] for own, path in made], axis=1)
        chosen = physics_oracle(forecasts, record.tracks[track].positions(frames[:, None] + STEPS_AHEAD))
        known = chosen.choice >= 0
        paths[track] = (frames[known], chosen.trajectory[known])
    return paths


@dataclass
class _Totals:
    """Metrics of one model over the scenes so far."""

    pairs: int
    scenes: int
    means: MetricMeans = field(default_factory=MetricMeans)
    instants: MetricMeans = field(default_factory=MetricMeans)
    statuses: Counter[str] = field(default_factory=Counter)
    lost: int = 0
    times: list[CallTimes] = field(default_factory=list)
    each: dict[str, Floats] = field(default_factory=dict)
    ratios: dict[str, Ratio] = field(default_factory=dict)

    def add(self, number: int, scene: SceneMetrics) -> None:
        """Add the metrics of a scene, by its index."""
        self.means.add(scene.metrics)
        self.instants.add(scene.instants)
        self.statuses.update(scene.statuses)
        self.lost += scene.lost
        if scene.times is not None:
            self.times.append(scene.times)
        for name in PER_INSTANCE:
            if name in scene.metrics:
                values = self.each.setdefault(name, np.full(self.pairs, np.nan))
                values[scene.instances] = scene.metrics[name]
        for name, values in scene.instants.items():
            ratio = self.ratios.setdefault(name, Ratio(np.zeros(self.scenes), np.zeros(self.scenes)))
            known = np.isfinite(values)
            ratio.sums[number], ratio.divisors[number] = values[known].sum(), known.sum()

    def result(self, model: Model | None, mismatch_m: Floats | None) -> BenchmarkModelResult:
        """Return the result of a model.

        Args:
            model: the model; None: the physics oracle.
            mismatch_m: [pairs], m, FDE at 6 s of the Kalman filter, which ranks the hard cases; None: it was
                not evaluated.
        """
        metrics = self.means.figures() | self.instants.means()
        if mismatch_m is not None and FDE in self.each:
            metrics |= hardest_fde(self.each[FDE], mismatch_m)
        described = Model(name=ORACLE) if model is None else model
        learned = model is not None and is_learned(model)
        return BenchmarkModelResult(
            name=described.name,
            version=described.version,
            protocol=protocol_of(described).value if learned else "any",
            trained_on=described.trained_on,
            statuses=dict(sorted(self.statuses.items())),
            metrics=metrics,
            instants=self.instants.count(CONSISTENCY[0]) if CONSISTENCY[0] in self.instants.names() else 0,
            lost=self.lost,
            latency=_latency(self.times),
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
