"""Submission to the nuScenes prediction challenge.

A JSON list with one entry per pair, as nuscenes-devkit reads it (``eval/prediction/data_classes.py``). The
devkit ranks modes by probability; entries are written so that it ranks them as ``model.metrics.multimodal``
does and computes the same figures.
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Final, TypedDict

import numpy as np

from benchmark.answers import SceneAnswers
from benchmark.errors import BenchmarkError
from benchmark.plan import PlannedScene
from model.arrays import Bools, Floats
from model.data.checks import FUTURE_STEPS
from model.evaluation.results import replacing
from model.metrics.multimodal import by_probability

MAX_MODES: Final = 25
"""Maximum number of modes of an entry; the devkit refuses more."""


class Entry(TypedDict):
    """The forecast of one pair."""

    instance: str
    sample: str
    prediction: list[list[list[float]]]
    """[modes][12][2], m, ground frame; the most likely mode first."""
    probabilities: list[float]
    """[modes], strictly falling; their sum is 1."""


def submission_entries(scene: PlannedScene, answers: SceneAnswers) -> list[Entry]:
    """Return the entries of a scene, in the order of its pairs.

    Of more than ``MAX_MODES`` modes the most likely are kept, and their probabilities normalised.

    Args:
        scene: the planned scene.
        answers: answers of one model.

    Raises:
        BenchmarkError: the data has no tokens, a pair has no forecast, or a forecast cannot be submitted.
    """
    where = scene.record.name
    if not all(pair.token for pair in scene.pairs):
        raise BenchmarkError(f"{where}: a submission needs data with tokens (nuscenes); this has none")
    missing = sorted(set(range(len(scene.pairs))) - set(answers.instances.tolist()))
    if missing:
        raise BenchmarkError(
            f"{where}: a submission needs a forecast of every pair; {len(missing)} of {len(scene.pairs)} "
            f"have none, the first {scene.pairs[missing[0]].token}"
        )
    if answers.mixture is None:
        return []
    modes = answers.mixture.world_means.numpy()
    probabilities = answers.mixture.weights.double().numpy()
    if modes.shape[2] != FUTURE_STEPS:
        raise BenchmarkError(
            f"{where}: a submission needs forecasts of {FUTURE_STEPS} steps, not {modes.shape[2]}"
        )
    if not (np.isfinite(modes).all() and np.isfinite(probabilities).all()):
        raise BenchmarkError(f"{where}: there are forecasts that are not finite")
    order = by_probability(probabilities)
    real = ~_padding(modes, probabilities)
    entries = []
    for row, pair in enumerate(scene.pairs):
        kept = order[row][real[row][order[row]]][:MAX_MODES]
        instance, _, sample = pair.token.partition("_")
        entries.append(
            Entry(
                instance=instance,
                sample=sample,
                prediction=modes[row, kept].tolist(),
                probabilities=_falling(probabilities[row, kept]).tolist(),
            )
        )
    return entries


def write_submission(entries: Iterable[Entry], file: Path) -> None:
    """Write a submission, one entry per line; an existing file is replaced only at the end.

    Args:
        entries: entries of all scenes, consumed one by one to save memory.
        file: the output file.

    Raises:
        OSError: the file cannot be written.
    """
    with replacing(file) as temporary, temporary.open("w", encoding="utf-8") as out:
        out.write("[")
        for number, entry in enumerate(entries):
            out.write(("," if number else "") + "\n" + json.dumps(entry, allow_nan=False))
        out.write("\n]\n")


def _padding(modes: Floats, probabilities: Floats) -> Bools:
    """Return the padding modes: [N, K].

    ``read_answers`` pads with copies of the first mode of weight 0 where another pair of the scene has more
    modes. The devkit's off-road rate would count each.
    """
    again = (modes == modes[:, :1]).all(axis=(-2, -1))
    again[:, 0] = False
    padding: Bools = again & (probabilities == 0)
    return padding


def _falling(probabilities: Floats) -> Floats:
    """Return ranked probabilities [K] that sum to 1 and strictly fall.

    Of equal ones each is raised a rounding error above the next: the devkit's order of ties among more than
    16 modes depends on numpy's version and the processor.
    """
    falling: Floats = probabilities / probabilities.sum()
    for mode in range(len(falling) - 2, -1, -1):
        falling[mode] = max(falling[mode], np.nextafter(falling[mode + 1], np.inf))
    return falling
