"""The bundled default model on made-up scenes, checked against a planner's expectations."""

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from tests.cases import checks, driving, scenes
from tests.cases import given as shared_cases
from tests.cases.bands import Reading, few_modes, readings, widths
from tests.cases.case import Case, Pose, Scenario, View
from tests.cases.checks import LocalForecast
from tests.cases.outside import OUTSIDE
from tests.cases.report import TURNED_WITHIN
from tests.cases.running import Served, bundled, network_frame

pytestmark = pytest.mark.cases

MODEL = "cab"
SCENARIOS = {one.name: one for one in scenes.at_poses(scenes.all_rows())}
DRIVES = {one.name: one for one in driving.drives()}


def known(asked: str, names: Iterable[str]) -> list[pytest.ParameterSet]:
    """Return test parameters; those known to be out of their bands are expected to fail."""
    fails = pytest.mark.xfail(strict=True, raises=AssertionError, reason="known to be out of its band")
    return [pytest.param(name, marks=[fails] if name in OUTSIDE[asked] else []) for name in names]


Answers = dict[str, tuple[Case, LocalForecast]]
"""Cases and their forecasts, by name."""


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    """Serve the model; skip models of the ground frame, which are known to be out of the bands."""
    with Served(bundled(MODEL)) as model:
        frame = network_frame(model.info)
        if frame != "agent":
            pytest.skip(f"{model.info.full_name} sees the {frame} frame; the bands are for the agent's")
        yield model


@pytest.fixture(scope="module")
def own(served: Served) -> Answers:
    """Forecast the project's own scenes."""
    return _answers(served, [scenario.case() for scenario in SCENARIOS.values()])


@pytest.fixture(scope="module")
def given_cases(served: Served, shared: Path) -> Answers:
    """Forecast the cases of the folder shared/."""
    folder = shared / "cases"
    if not folder.is_dir():
        pytest.skip(f"the shared cases are not here: {folder}")
    return _answers(served, shared_cases.read_cases(folder))


@pytest.mark.parametrize("name", known("row", SCENARIOS))
def test_the_row_holds(own: Answers, served: Served, name: str) -> None:
    _within(_row(own, name, served.info.name))


@pytest.mark.parametrize("name", known("width", SCENARIOS))
def test_no_mode_that_moves_is_too_narrow(own: Answers, name: str) -> None:
    _within(widths(own[name][1]))


@pytest.mark.parametrize("name", known("modes", SCENARIOS))
def test_few_modes_hold_the_weight(own: Answers, name: str) -> None:
    _within(few_modes(own[name][1]))


@pytest.mark.parametrize("name", known("shared row", shared_cases.KNOWN))
def test_the_row_of_a_shared_case_holds(given_cases: Answers, served: Served, name: str) -> None:
    _within(_row(given_cases, name, served.info.name))


@pytest.mark.parametrize("name", known("shared modes", shared_cases.KNOWN))
def test_a_shared_case_has_few_modes_and_none_too_narrow(given_cases: Answers, name: str) -> None:
    _within([*widths(given_cases[name][1]), *few_modes(given_cases[name][1])])


@pytest.mark.parametrize("name", known("drive", DRIVES))
def test_the_likeliest_end_does_not_jump_from_tick_to_tick(served: Served, name: str) -> None:
    drive = DRIVES[name]
    _within(drive.readings(served.answer([one.case() for one in drive.ticks])))


@pytest.mark.parametrize("view", known("turned", get_args(View)))
def test_a_turned_and_shifted_scene_has_the_turned_forecasts(served: Served, view: View) -> None:
    # Failures are not shrunk: every example takes a forward pass, and all angles are equally informative
    @settings(
        max_examples=12, deadline=None, derandomize=True, phases=[Phase.explicit, Phase.reuse, Phase.generate]
    )
    @given(
        scenario=st.sampled_from(list(SCENARIOS.values())),
        angle=st.floats(-math.pi, math.pi),
        x=st.floats(-1e4, 1e4),
        y=st.floats(-1e4, 1e4),
    )
    def holds(scenario: Scenario, angle: float, x: float, y: float) -> None:
        here, there = Pose(), Pose(x, y, angle)
        one, other = served.answer([scenario.at(pose).case(view) for pose in (here, there)])
        assert checks.apart(one, other) <= TURNED_WITHIN[view]

    holds()


def _answers(served: Served, cases: list[Case]) -> Answers:
    return {case.name: (case, forecast) for case, forecast in zip(cases, served.answer(cases), strict=True)}


def _row(answers: Answers, name: str, model: str) -> list[Reading]:
    case, forecast = answers[name]
    companion = answers[case.facts.companion][1] if case.facts.companion else None
    return readings(case, forecast, companion, model)


def _within(found: list[Reading]) -> None:
    wrong = [str(one) for one in found if not one.ok]
    assert not wrong, "; ".join(wrong)
