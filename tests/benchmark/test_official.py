"""Submissions in the hands of nuScenes' own evaluator (needs nuscenes-devkit: ``make test-nuscenes``).

A server forecasts, the benchmark asks it, and the evaluator has to find what our metrics find: on the real
mini scenes, and on a data set that is made here.
"""

import asyncio
import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmark.answers import SceneAnswers, read_answers
from benchmark.archive import Archive
from benchmark.models import select
from benchmark.plan import PlannedScene, plan_scenes
from benchmark.replay import Replay
from benchmark.submission import Entry, submission_entries, write_submission
from cab_forecast import AsyncClient
from model.arrays import Floats
from model.checkpoint import load_checkpoint
from model.data.nuscenes import NuscenesReader
from model.forecaster import Protocol
from model.metrics.displacement import displacement_m
from model.metrics.evaluate import instance_metrics
from model.metrics.multimodal import TOP_K
from model.metrics.offroad_devkit import off_road_rate_devkit
from model.metrics.oracle import PHYSICS, Criterion, physics_oracle
from service.settings import bundled_models
from tests.model.data.dataroot import LOCATION, write_dataroot
from tests.service.servers import running

pytestmark = [
    pytest.mark.skipif(find_spec("nuscenes") is None, reason="nuscenes-devkit is not installed"),
    # Of the devkit's own dependencies
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),
]

LEARNED, SINGLE = "trajectron", "constant-velocity-yaw"
OURS = {"MinADEK": "min_ade_{}_m", "MinFDEK": "min_fde_{}_m", "MissRateTopK_2": "miss_rate_{}"}
"""Names of our figures by the evaluator's."""
VERSION = "v1.0-mini"


@dataclass(frozen=True)
class Answered:
    """A split with the answers of a server."""

    dataroot: Path
    scenes: Sequence[PlannedScene]
    answers: Mapping[str, Sequence[SceneAnswers]]
    """Answers about each scene, by the models' names."""

    def entries(self, model: str) -> list[Entry]:
        """The submission."""
        each = zip(self.scenes, self.answers[model], strict=True)
        return list(chain.from_iterable(submission_entries(scene, answers) for scene, answers in each))

    def figures(self, model: str) -> dict[str, list[float]]:
        """Ours under the evaluator's names, by k."""
        parts = [
            instance_metrics(answers.mixture, scene.truth())
            for scene, answers in zip(self.scenes, self.answers[model], strict=True)
            if answers.mixture is not None
        ]
        return {
            theirs: [float(np.concatenate([part[ours.format(k)] for part in parts]).mean()) for k in TOP_K]
            for theirs, ours in OURS.items()
        }

    def most_likely(self, model: str) -> Floats:
        """[N, 12, 2], m, ground frame, of all pairs."""
        mixtures = [answers.mixture for answers in self.answers[model]]
        return np.concatenate([one.most_likely_trajectory().numpy() for one in mixtures if one is not None])


def ask(dataroot: Path, split: str, folder: Path, models: Sequence[str]) -> Answered:
    """Answers of a server that runs for as long."""

    async def replay() -> dict[str, list[SceneAnswers]]:
        bundled = bundled_models()
        assert bundled is not None
        learned = load_checkpoint(bundled / LEARNED).forecaster()
        async with running(learned) as server, AsyncClient(f"grpc://{server.grpc_address}") as client:
            chosen = select(await client.list_models(), Protocol.CAUSAL, models)
            with Archive(folder) as archive:
                replayed = await Replay(scenes, chosen, Protocol.CAUSAL).run(client, archive, lambda _: None)
                assert not replayed.refused
                return {
                    model.name: [read_answers(archive, key, scene) for scene in scenes]
                    for key, model in chosen.items()
                }

    scenes = list(plan_scenes(NuscenesReader(dataroot), split, consistency=False))
    return Answered(dataroot, scenes, asyncio.run(replay()))


@pytest.fixture(scope="module", params=["made", "real"])
def answered(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Answered:
    """Three pairs of a made scene, or the 61 of mini_val."""
    folder = tmp_path_factory.mktemp(request.param)
    if request.param == "real":
        shared: Path = request.getfixturevalue("shared")
        return ask(shared / "data/nuscenes", "mini_val", folder, (LEARNED, SINGLE))
    write_dataroot(folder / "nuscenes")
    _map_everywhere(folder / "nuscenes/maps/expansion")
    return ask(folder / "nuscenes", "mini_train", folder, (LEARNED, SINGLE))


def _map_everywhere(folder: Path) -> None:
    """The official command wants the maps of all four places."""
    for location in import_module("nuscenes.map_expansion.map_api").locations:
        if location != LOCATION:
            shutil.copy(folder / f"{LOCATION}.json", folder / f"{location}.json")


def _helper(dataroot: Path) -> Any:
    database = import_module("nuscenes.nuscenes").NuScenes(VERSION, str(dataroot), verbose=False)
    return import_module("nuscenes.prediction").PredictHelper(database)


def _official(helper: Any, entries: Sequence[Mapping[str, Any]]) -> dict[str, list[float]]:
    """Figures by metric and k."""
    metrics = import_module("nuscenes.eval.prediction.metrics")
    config = import_module("nuscenes.eval.prediction.config").PredictionConfig(
        [
            metrics.MinADEK(list(TOP_K), [metrics.RowMean()]),
            metrics.MinFDEK(list(TOP_K), [metrics.RowMean()]),
            metrics.MissRateTopK(list(TOP_K), [metrics.RowMean()], tolerance=2),
        ]
    )
    compute = import_module("nuscenes.eval.prediction.compute_metrics").compute_metrics
    return {name: means["RowMean"] for name, means in compute(entries, helper, config).items()}


def _assert_same(found: Mapping[str, Sequence[float]], expected: Mapping[str, Sequence[float]]) -> None:
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=0, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("model", [LEARNED, SINGLE])
def test_the_evaluator_finds_our_figures(answered: Answered, model: str) -> None:
    entries, ours = answered.entries(model), answered.figures(model)
    assert len(entries) == sum(len(scene.pairs) for scene in answered.scenes)
    assert {len(entry["probabilities"]) for entry in entries} == {25 if model == LEARNED else 1}
    if model == LEARNED and len(entries) > 3:
        assert ours["MinADEK"][0] > ours["MinADEK"][2]  # k does matter
    _assert_same(_official(_helper(answered.dataroot), entries), ours)


def test_the_official_command(answered: Answered, tmp_path: Path) -> None:
    submission = tmp_path / "submission.json"
    write_submission(answered.entries(LEARNED), submission)
    command = [sys.executable, "-m", "nuscenes.eval.prediction.compute_metrics", "--version", VERSION]
    command += ["--data_root", str(answered.dataroot), "--submission_path", str(submission)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "submission_metrics.json").read_text())
    figures = {name: means["RowMean"] for name, means in found.items()}
    assert figures.keys() == {*OURS, "OffRoadRate"}
    _assert_same(figures, answered.figures(LEARNED))
    # Its map is finer than ours, and has no lanes
    rates = [
        off_road_rate_devkit(scene.record.raster, modes)
        for scene, answers in zip(answered.scenes, answered.answers[LEARNED], strict=True)
        if answers.mixture is not None
        for modes in answers.mixture.world_means.numpy()
    ]
    assert figures["OffRoadRate"] == pytest.approx([np.mean(rates)], abs=0.03)


def test_the_physics_oracle(shared: Path, tmp_path: Path) -> None:
    """Ours is the devkit's within 1 %, whose speeds are of recorded times where ours are of nominal ones."""
    answered = ask(shared / "data/nuscenes", "mini_train", tmp_path, PHYSICS)
    helper = _helper(answered.dataroot)
    oracle = import_module("nuscenes.prediction.models.physics").PhysicsOracle(6, helper)
    tokens = [pair.token for scene in answered.scenes for pair in scene.pairs]
    official = _official(helper, [oracle(token).serialize() for token in tokens])
    theirs = np.array([official["MinADEK"][0], official["MinFDEK"][0]])
    np.testing.assert_allclose(theirs, [3.935, 9.266], rtol=0, atol=0.0005)  # of 742 pairs
    four = np.stack([answered.most_likely(model) for model in PHYSICS], axis=1)
    truth = np.concatenate([scene.truth() for scene in answered.scenes])
    for criterion in Criterion:
        errors_m = displacement_m(physics_oracle(four, truth, criterion).trajectory, truth)
        np.testing.assert_allclose([errors_m.mean(), errors_m[:, -1].mean()], theirs, rtol=0.01)
