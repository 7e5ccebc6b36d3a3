"""Three measures of what the context does for a forecast: gain, right-context advantage, compliance.

Each is over three sets of pairs: all, the hardest 10 % (of the Kalman filter), turns that begin after now.
Intervals are those of ``benchmark.bootstrap``: 95 %, over scenes.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from benchmark.answers import read_answers
from benchmark.archive import Archive
from benchmark.bootstrap import Ratio, mean_interval
from benchmark.context.cases import Case, Cases, Change
from benchmark.errors import BenchmarkError
from benchmark.plan import PlannedScene
from benchmark.results import ALL, HARDEST, TURNS, Estimate, subset_figure
from cab_forecast import forecasts
from model.arrays import Bools, Floats, Ints
from model.data.checks import FUTURE_STEPS, STEPS_AHEAD
from model.metrics.displacement import displacement_m, fde_m
from model.metrics.hard import hardest_of_known
from model.metrics.offroad import off_road
from model.metrics.path_fan import on_road_path_exists
from model.metrics.turns import turns_after_now

HARD_SHARE: Final = 0.1
"""Share of the pairs that are the hardest."""
HORIZON_S: Final = 6.0
"""Horizon of the errors and of off-road rates, s."""


@dataclass(frozen=True)
class ContextFigures:
    """Figures of one model for each of N pairs; NaN where unknown."""

    fde_m: Floats
    """[N], m, FDE at 6 s with the pair's own context."""
    changed_fde_m: Mapping[Change, Floats]
    """[N] each, m, FDE with a changed context, mean over the donors."""
    off_road: Floats
    """[N], number of forecasts that leave the road of a donor's map, of those maps on which the agent has a
    path on the road."""
    no_context_off_road: Floats
    """[N], the same number for the model without context."""
    missing: int
    """Number of cases without a forecast."""

    def differences(self, no_context_fde_m: Floats) -> dict[str, Floats]:
        """Return the measures that are differences of two FDE, [N] each, m.

        Args:
            no_context_fde_m: [N], m, FDE of the model without context.
        """
        control = self.changed_fde_m[Change.CONTROL] - self.fde_m
        return {
            "gain_m": no_context_fde_m - self.fde_m,
            "map_advantage_m": self.changed_fde_m[Change.MAP] - self.fde_m,
            "neighbors_advantage_m": self.changed_fde_m[Change.NEIGHBORS] - self.fde_m,
            "map_control_m": control,
            "map_control_size_m": np.abs(control),
        }


def measure_context(
    figures: ContextFigures, no_context_fde_m: Floats, subsets: Mapping[str, Bools], scenes: Ints
) -> dict[str, dict[str, Estimate]]:
    """Return the measures of one model, by subset and name; those without a pair are left out.

    Args:
        figures: the model's figures of N pairs.
        no_context_fde_m: [N], m, FDE of the model without context.
        subsets: [N] each, which pairs belong to a subset.
        scenes: [N], index of each pair's scene.
    """
    differences = figures.differences(no_context_fde_m)
    found: dict[str, dict[str, Estimate]] = {}
    for subset, members in subsets.items():
        estimates = {name: _mean(values[members], scenes[members]) for name, values in differences.items()}
        estimates["compliance"] = _compliance(
            figures.off_road[members], figures.no_context_off_road[members], scenes[members]
        )
        found[subset] = {name: one for name, one in estimates.items() if one.pairs}
    return {subset: estimates for subset, estimates in found.items() if estimates}


def measures_by_scenes(
    figures: ContextFigures, no_context_fde_m: Floats, subsets: Mapping[str, Bools], scenes: Ints
) -> dict[str, Ratio]:
    """Return what the measures of one model are computed of, by ``results.subset_figure`` of name and subset.

    Args:
        figures: the model's figures of N pairs.
        no_context_fde_m: [N], m, FDE of the model without context.
        subsets: [N] each, which pairs belong to a subset.
        scenes: [N], index of each pair's scene.
    """
    ones = np.ones(len(scenes))
    parts = {name: (values, ones) for name, values in figures.differences(no_context_fde_m).items()}
    reference = figures.no_context_off_road
    parts["compliance"] = (reference - figures.off_road, reference)
    return {
        subset_figure(name, subset): Ratio.of(np.where(members, values, np.nan), divisors, scenes)
        for subset, members in subsets.items()
        for name, (values, divisors) in parts.items()
    }


def context_subsets(scenes: Sequence[PlannedScene], mismatch_m: Floats | None) -> dict[str, Bools]:
    """Return which pairs belong to each subset, [N] each.

    Args:
        scenes: the planned scenes.
        mismatch_m: [N], m, FDE of the Kalman filter; None: unknown, without hardest pairs.
    """
    subsets = {ALL: np.ones(sum(len(scene.pairs) for scene in scenes), dtype=np.bool_)}
    if mismatch_m is not None and np.isfinite(mismatch_m).any():
        subsets[HARDEST] = hardest_of_known(mismatch_m, HARD_SHARE)
    subsets[TURNS] = np.concatenate([_turns(scene) for scene in scenes])
    return subsets


def most_likely_paths(archive: Archive, model: str, scenes: Sequence[PlannedScene]) -> Floats:
    """Return the most likely trajectories of a model with the pairs' own context: [N, 12, 2], m; NaN where
    missing.

    Args:
        archive: answers of a benchmark of the same plan.
        model: ``name@version``.
        scenes: the planned scenes.

    Raises:
        BenchmarkError: an answer does not fit its call, or there is none.
    """
    paths = np.full((sum(len(scene.pairs) for scene in scenes), FUTURE_STEPS, 2), np.nan)
    for scene in scenes:
        answers = read_answers(archive, model, scene)
        if answers.mixture is not None:
            paths[scene.first + answers.instances] = answers.mixture.most_likely_trajectory().numpy()
    if not np.isfinite(paths).any():
        raise BenchmarkError(f"there are no answers of {model}, with which the others are compared")
    return paths


class ContextEvaluation:
    """Evaluation of the answers about all cases.

    Args:
        cases: the cases.
        scenes: the planned scenes.
        no_context: [N, 12, 2], m, most likely trajectories of the model without context.
    """

    def __init__(self, cases: Cases, scenes: Sequence[PlannedScene], no_context: Floats) -> None:
        self._cases = cases.cases
        self._agents = cases.pool.agents
        self._scenes = scenes
        self._truth = np.concatenate([scene.truth() for scene in scenes])
        self._no_context = no_context
        self._passable = [case.change is Change.MAP and self._has_path(case) for case in self._cases]

    @property
    def scene_of(self) -> Ints:
        """[N], index of each pair's scene."""
        return np.array([agent.scene for agent in self._agents], dtype=np.int64)

    def no_context_fde_m(self) -> Floats:
        """Return the FDE at 6 s of the model without context: [N], m."""
        return fde_m(displacement_m(self._no_context, self._truth), HORIZON_S)

    def figures(
        self,
        path_of: Callable[[Case], Floats | None],
        own_fde_m: Floats,
        tick: Callable[[int], None] = lambda cases: None,
    ) -> ContextFigures:
        """Return the figures of one model.

        Args:
            path_of: returns the most likely trajectory in a case, [12, 2], m; None: missing. See ``answers``
                and ``unchanged``.
            own_fde_m: [N], m, FDE at 6 s with the pair's own context.
            tick: called with the number of cases that are done.

        Raises:
            BenchmarkError: an answer does not fit its call.
        """
        count = len(self._agents)
        sums = {change: np.zeros(count) for change in Change}
        numbers = {change: np.zeros(count) for change in Change}
        off_roads, compared = np.zeros((2, count)), np.zeros(count)
        for case, passable in zip(self._cases, self._passable, strict=True):
            path = path_of(case)
            if path is not None:
                error_m = displacement_m(path, self._truth[case.number])
                sums[case.change][case.number] += fde_m(error_m, HORIZON_S)
                numbers[case.change][case.number] += 1
                both = np.stack([path, self._no_context[case.number]])
                if passable and np.isfinite(both).all():
                    raster = self._scenes[case.scene].record.raster
                    off_roads[:, case.number] += off_road(raster, case.move.inverse.points(both))
                    compared[case.number] += 1
            tick(1)
        off_roads[:, compared == 0] = np.nan
        with np.errstate(invalid="ignore"):  # 0/0 where a pair has no donor
            means = {change: sums[change] / numbers[change] for change in Change}
        missing = len(self._cases) - int(sum(found.sum() for found in numbers.values()))
        return ContextFigures(own_fde_m, means, off_roads[0], off_roads[1], missing)

    def answers(self, archive: Archive, model: str) -> Callable[[Case], Floats | None]:
        """Return the trajectories of a model that was asked about the cases.

        Args:
            archive: the saved answers about the cases.
            model: ``name@version``.
        """
        return partial(self._path, archive, model)

    @staticmethod
    def unchanged(paths: Floats) -> Callable[[Case], Floats | None]:
        """Return the trajectories of a model that sees no context: in any case those with the own one.

        Args:
            paths: [N, 12, 2], m; NaN where missing.
        """
        return lambda case: paths[case.number] if np.isfinite(paths[case.number]).all() else None

    def _path(self, archive: Archive, model: str, case: Case) -> Floats | None:
        agent = self._agents[case.number]
        track_id = self._scenes[agent.scene].record.tracks[agent.track].id
        for _, answer in archive.answers(model, case.name):
            try:
                forecast = forecasts(answer.response).get(track_id)
            except ValueError as error:
                raise BenchmarkError(
                    f"{model}, {case.name}: an answer contradicts itself: {error}"
                ) from error
            if forecast is not None and len(forecast.weights):
                path: Floats = forecast.most_likely
                if path.shape != (FUTURE_STEPS, 2):
                    raise BenchmarkError(f"{model}, {case.name}: a forecast of {len(path)} steps")
                return path
        return None

    def _has_path(self, case: Case) -> bool:
        """Return whether the agent has a path on the road of the donor's map."""
        agent = self._agents[case.number]
        raster = self._scenes[case.scene].record.raster
        donor = case.move.source
        return on_road_path_exists(raster, donor.position, donor.heading, agent.speed, FUTURE_STEPS)


def _turns(scene: PlannedScene) -> Bools:
    tracks = scene.record.tracks
    past, future = (
        np.stack([tracks[pair.track].headings(pair.frame + frames) for pair in scene.pairs])
        for frames in (np.arange(-4, 1), STEPS_AHEAD)
    )
    return turns_after_now(past, future)


def _mean(values: Floats, scenes: Ints) -> Estimate:
    known = np.isfinite(values)
    values, scenes = values[known], scenes[known]
    if not len(values):
        return Estimate(math.nan, math.nan, math.nan, 0)
    return Estimate(float(values.mean()), *mean_interval(values, scenes), len(values))


def _compliance(off: Floats, no_context_off: Floats, scenes: Ints) -> Estimate:
    """Return 1 − off-road rate / off-road rate of the model without context."""
    known = np.isfinite(off)
    off, no_context_off, scenes = off[known], no_context_off[known], scenes[known]
    total = float(no_context_off.sum())
    if not total:
        return Estimate(math.nan, math.nan, math.nan, 0)
    low, high = mean_interval(off, scenes, no_context_off)
    return Estimate(1 - float(off.sum()) / total, 1 - high, 1 - low, len(off))
