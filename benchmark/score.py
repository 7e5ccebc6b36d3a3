"""Figures of one scene's answers, by the metrics of ``model.metrics``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from benchmark.answers import CallTimes, SceneAnswers, read_answers
from benchmark.archive import Archive
from benchmark.consistency import consistency_metrics
from benchmark.models import oldest_first
from benchmark.plan import PlannedScene
from model.arrays import Floats, Ints
from model.data.checks import STEPS_AHEAD
from model.data.scenes import SceneRecord
from model.metrics.evaluate import instance_metrics
from model.metrics.oracle import ORACLE, PHYSICS, oracle_figures, oracle_mixture, physics_oracle

SEEDS = 1_000_003
"""Between the seeds of two runs of successive ``seed``: more than any split has pairs."""


@dataclass(frozen=True)
class Judging:
    """How answers are judged."""

    samples: int
    """Trajectories drawn for each pair (ADE-f, FDE-f, OffR-f); 0 leaves such figures out."""
    draws: int
    """Positions drawn at each step for calibration; 0 leaves it out."""
    seed: int
    consistency: bool
    """Whether dispersion and convergence are judged."""


@dataclass(frozen=True)
class SceneScore:
    """One model on one scene."""

    instances: Ints
    """[n], numbers of the pairs that have a forecast among those of all scenes."""
    metrics: Mapping[str, Floats]
    """[n] each, by the names of ``instance_metrics``."""
    instants: Mapping[str, Floats] = field(default_factory=dict)
    """[P] each, by the names of ``consistency.METRICS``."""
    statuses: Mapping[str, int] = field(default_factory=dict)
    """How many pairs came out how."""
    lost: int = 0
    """Forecasts that were asked for dispersion and convergence alone, and did not come."""
    times: CallTimes | None = None


def judge_scene(
    folder: Path, scene: PlannedScene, models: Sequence[str], judging: Judging
) -> dict[str, SceneScore]:
    """Judges what an archive has about one scene. Runs in a process of its own.

    Args:
        folder: of the archive.
        scene: what was asked.
        models: ``name@version``; where the four physics baselines are among them, the oracle of their newest
            versions is judged, too.
        judging: how.

    Returns:
        By ``name@version``, and by the oracle's name.
    """
    torch.set_num_threads(1)  # every core has a scene of its own
    with Archive(folder, read_only=True) as archive:
        answers = {model: read_answers(archive, model, scene) for model in models}
    truth = scene.truth()
    scores = {model: _score(scene, given, truth, judging) for model, given in answers.items()}
    by_name = {model.partition("@")[0]: answers[model] for model in oldest_first(answers)}
    if set(PHYSICS) <= by_name.keys():
        scores[ORACLE] = _oracle(scene, {name: by_name[name] for name in PHYSICS}, truth, judging)
    return scores


def _score(scene: PlannedScene, answers: SceneAnswers, truth: Floats, judging: Judging) -> SceneScore:
    numbers = answers.instances + scene.first
    score = SceneScore(numbers, {}, {}, answers.statuses, answers.lost, answers.times)
    if answers.mixture is not None:
        metrics = instance_metrics(
            answers.mixture,
            truth[answers.instances],
            [scene.record.raster] * len(numbers),
            (numbers + judging.seed * SEEDS).tolist(),
            samples=judging.samples,
            draws=judging.draws,
            stood=scene.stood()[answers.instances],
        )
        score = replace(score, metrics=metrics)
    if judging.consistency:
        score = replace(score, instants=consistency_metrics(scene.record, answers.likeliest))
    return score


def _oracle(
    scene: PlannedScene, answers: Mapping[str, SceneAnswers], truth: Floats, judging: Judging
) -> SceneScore:
    """Of pairs and instants that all four have a forecast for."""
    known = [one.instances for one in answers.values()]
    instances = known[0][np.logical_and.reduce([np.isin(known[0], one) for one in known])]
    metrics: dict[str, Floats] = {}
    if len(instances):
        mixtures = {
            name: one.mixture[torch.from_numpy(np.searchsorted(one.instances, instances))]
            for name, one in answers.items()
            if one.mixture is not None
        }
        best = oracle_mixture(mixtures, truth[instances])
        metrics = oracle_figures(
            instance_metrics(
                best,
                truth[instances],
                [scene.record.raster] * len(instances),
                stood=scene.stood()[instances],
            )
        )
    score = SceneScore(instances + scene.first, metrics)
    if judging.consistency:
        paths = _oracle_paths(scene.record, [one.likeliest for one in answers.values()])
        score = replace(score, instants=consistency_metrics(scene.record, paths))
    return score


def _oracle_paths(
    record: SceneRecord, likeliest: Sequence[Mapping[int, tuple[Ints, Floats]]]
) -> dict[int, tuple[Ints, Floats]]:
    """What the oracle would have said at every frame, as ``SceneAnswers.likeliest``."""
    paths = {}
    for track in set.intersection(*(set(one) for one in likeliest)):
        made = [one[track] for one in likeliest]
        frames = made[0][0][np.logical_and.reduce([np.isin(made[0][0], frames) for frames, _ in made])]
        forecasts = np.stack([path[np.searchsorted(own, frames)] for own, path in made], axis=1)
        chosen = physics_oracle(forecasts, record.tracks[track].positions(frames[:, None] + STEPS_AHEAD))
        known = chosen.choice >= 0
        paths[track] = (frames[known], chosen.trajectory[known])
    return paths
