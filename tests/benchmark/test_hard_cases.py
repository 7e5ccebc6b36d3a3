"""Hard cases by hand."""

import math

import numpy as np
import pytest
import torch

from benchmark.hard_cases import SHOWN, hard_case, hardest_fde, shown_cases
from model.mixture import TrajectoryMixture
from tests.benchmark.scenes import PAIRS, planned


def test_the_hardest_pairs_are_those_of_the_kalman_filter() -> None:
    """The worst 1, 2 and 3 of 100 ranked pairs count; pairs without a rank or an FDE are left out."""
    mismatch_m = np.append(np.arange(100.0), np.nan)
    fde_m = np.append(np.zeros(97), [3.0, np.nan, 9.0, 1000.0])
    assert hardest_fde(fde_m, mismatch_m) == {
        "fde_hardest_1_m": 9.0,
        "fde_hardest_2_m": 9.0,
        "fde_hardest_3_m": 6.0,
        "fde_hardest_all_m": pytest.approx(12 / 99),
    }


def test_without_a_rank_there_are_no_hard_cases() -> None:
    figures = hardest_fde(np.ones(2), np.full(2, np.nan))
    assert list(figures) == ["fde_hardest_all_m"]
    assert math.isnan(figures["fde_hardest_all_m"])


def test_the_hardest_pair_of_each_agent_is_shown() -> None:
    scenes = planned()
    mismatch_m = np.random.default_rng(0).permutation(PAIRS).astype(float)
    mismatch_m[mismatch_m.argmax()] = np.nan
    shown = shown_cases(scenes, mismatch_m)
    found = [mismatch_m[scene.first + number] for scene, number in shown]
    assert found == sorted(found, reverse=True)
    assert found[0] == np.nanmax(mismatch_m)
    agents = [(scene.record.name, scene.pairs[number].track) for scene, number in shown]
    assert len(set(agents)) == len(agents) == SHOWN
    for (scene, _), agent, worst in zip(shown, agents, found, strict=True):
        of_agent = [i for i, pair in enumerate(scene.pairs) if pair.track == agent[1]]
        assert worst == np.nanmax(mismatch_m[scene.first + np.array(of_agent)])


def test_a_case_holds_the_pair_and_its_forecasts() -> None:
    scene = planned()[1]
    truth = scene.truth()[7]
    off = torch.tensor([[0.0, 3.0], [4.0, 0.0]])[None, :, None]  # [1, K, 1, 2]
    origin = torch.from_numpy(scene.origin()[7:8])
    mixture = TrajectoryMixture(
        torch.tensor([[0.25, 0.75]]).log(),
        torch.from_numpy(truth) - origin[:, None, None] + off,
        torch.eye(2).expand(1, 2, 12, 2, 2),
        origin,
    )
    case = hard_case(scene, 7, 12.5, {"cab@1.0.0": mixture})
    pair = scene.pairs[7]
    track = scene.record.tracks[pair.track]
    assert (case.scene, case.agent, case.frame, case.mismatch_m) == ("scene-2", track.id, pair.frame, 12.5)
    np.testing.assert_array_equal(case.truth, truth)
    np.testing.assert_array_equal(case.history[-1], scene.origin()[7])
    assert len(case.others) == sum(pair.frame in one.frames for one in scene.record.tracks) - 1
    forecast = case.forecasts["cab@1.0.0"]
    assert forecast.fde_6s_m == pytest.approx(4.0)
    np.testing.assert_allclose(forecast.weights, [0.25, 0.75], rtol=1e-6)
    np.testing.assert_array_equal(forecast.most_likely, forecast.modes[1])
