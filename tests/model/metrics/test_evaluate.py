import numpy as np
import pytest
import torch

from model.arrays import Floats
from model.metrics import density, displacement, multimodal, offroad
from model.metrics.evaluate import MOVING, MOVING_FIGURES, instance_metrics
from model.mixture import TrajectoryMixture, merge_modes
from tests.model.metrics.builders import certain, random_mixture, raster

SEEDS = [11, 12, 13]
ROAD = raster(np.ones((50, 50), dtype=np.uint8), 0.1, (-250.0, -250.0))
HORIZONS = range(1, 7)
ALWAYS = {
    *(f"{name}_{of}_{h}s_m" for name in ("ade", "fde") for of in ("ml", "merged") for h in HORIZONS),
    *(name.format(k) for name in ("min_ade_{}_m", "min_fde_{}_m", "miss_rate_{}") for k in (1, 5, 10)),
    *(f"nll_{h}s" for h in HORIZONS),
    *(f"merged_{name}_{k}_m" for name in ("min_ade", "min_fde", "brier_min_fde") for k in (5, 10)),
    "merged_miss_rate_5",
    "merged_miss_rate_10",
    "merged_modes_90",
    "merged_first_weight",
    "leaving_weight_3s",
    "nll",
    "nll_joint",
}
SAMPLED = {f"{name}_f_{h}s_m" for name in ("ade", "fde") for h in HORIZONS}
CALIBRATED = {
    *(f"inside_{p}" for p in (50, 90, 99)),
    *(f"inside_{p}_{h}s" for p in (50, 90, 99) for h in HORIZONS),
}


def _truth(mixture: TrajectoryMixture) -> Floats:
    return np.asarray(mixture.most_likely_trajectory().numpy() + np.linspace(0.1, 3, 12)[:, None])


def test_names_are_stable() -> None:
    m = random_mixture(0)
    truth = _truth(m)
    assert set(instance_metrics(m, truth)) == ALWAYS
    assert set(instance_metrics(m, truth, [ROAD] * 3)) == ALWAYS | {"off_road_ml"}
    sampled = instance_metrics(m, truth, [ROAD] * 3, SEEDS, samples=20)
    assert set(sampled) == ALWAYS | SAMPLED | CALIBRATED | {"off_road_ml", "off_road_f"}
    assert set(instance_metrics(m, truth, seeds=SEEDS, samples=0)) == ALWAYS | CALIBRATED
    assert set(instance_metrics(m, truth, seeds=SEEDS, samples=20, draws=0)) == ALWAYS | SAMPLED
    for values in sampled.values():
        assert values.shape == (3,)
        assert values.dtype == np.float64
        assert np.isfinite(values).all()


def test_values_are_those_of_the_modules() -> None:
    m = random_mixture(1)
    truth = _truth(m)
    got = instance_metrics(m, truth, [ROAD, None, ROAD], SEEDS, samples=50, noise_m=0.2)
    errors = displacement.displacement_m(m.most_likely_trajectory().numpy(), truth)
    drawn = m.sample(50, SEEDS).numpy()
    expected = displacement.expected_displacement_m(drawn, truth)
    rank = density.density_rank(m, truth, SEEDS, 0.2)
    nll = density.nll(m, truth, 0.2)
    for h in HORIZONS:
        step = 2 * h - 1
        np.testing.assert_allclose(got[f"ade_ml_{h}s_m"], errors[:, : step + 1].mean(axis=1))
        np.testing.assert_allclose(got[f"fde_ml_{h}s_m"], errors[:, step])
        np.testing.assert_allclose(got[f"ade_f_{h}s_m"], displacement.ade_m(expected, h))
        np.testing.assert_allclose(got[f"fde_f_{h}s_m"], displacement.fde_m(expected, h))
        np.testing.assert_allclose(got[f"nll_{h}s"], nll[:, step])
        np.testing.assert_array_equal(got[f"inside_90_{h}s"], rank[:, step] < 0.9)
    np.testing.assert_allclose(got["nll"], nll.mean(axis=1))
    np.testing.assert_allclose(got["inside_50"], (rank < 0.5).mean(axis=1))
    np.testing.assert_allclose(got["nll_joint"], density.joint_nll(m, truth, 0.2))
    np.testing.assert_array_equal(got["off_road_ml"], [0, np.nan, 0])
    np.testing.assert_allclose(got["off_road_f"], offroad.expected_off_road([ROAD, None, ROAD], drawn))
    modes, probabilities = m.world_means.numpy(), m.weights.numpy()
    np.testing.assert_allclose(got["min_ade_5_m"], multimodal.min_ade_m(modes, probabilities, truth, 5))
    np.testing.assert_allclose(got["min_ade_1_m"], got["ade_ml_6s_m"])
    np.testing.assert_allclose(got["min_fde_1_m"], got["fde_ml_6s_m"])


def test_batching_makes_no_difference() -> None:
    m = random_mixture(2, agents=40)
    truth, seeds = _truth(m), list(range(40))
    whole = instance_metrics(m, truth, [ROAD] * 40, seeds)  # 2000 samples: in several parts
    for start in (0, 27):
        some = slice(start, start + 13)
        part = instance_metrics(m[some], truth[some], [ROAD] * 13, seeds[some])
        for name, values in part.items():
            np.testing.assert_allclose(values, whole[name][some], rtol=1e-12, err_msg=name)


def test_a_certain_forecast_that_is_right() -> None:
    m = certain(random_mixture(3, modes=1))
    got = instance_metrics(m, m.most_likely_trajectory().numpy(), [ROAD] * 3, SEEDS, samples=7)
    for name, values in got.items():
        if name.startswith("inside") or name in (
            "merged_modes_90",
            "merged_first_weight",
            "leaving_weight_3s",
        ):
            assert (values == 1).all(), name
        elif not name.startswith("nll"):
            np.testing.assert_allclose(values, 0, atol=1e-12, err_msg=name)


def test_an_unknown_step_counts_where_it_is_used() -> None:
    m = random_mixture(4)
    truth = _truth(m)
    truth[1, 4] = np.nan  # at 2.5 s
    got = instance_metrics(m, truth, [ROAD] * 3, SEEDS, samples=5)
    for name, values in got.items():
        assert np.isfinite(values[[0, 2]]).all(), name
    unknown = {name for name, values in got.items() if np.isnan(values[1])}
    assert "ade_ml_2s_m" not in unknown
    assert "nll_3s" not in unknown
    assert {"ade_ml_3s_m", "ade_f_6s_m", "min_ade_5_m", "miss_rate_1", "nll", "nll_joint"} <= unknown


def test_short_forecasts_have_fewer_horizons() -> None:
    m = random_mixture(5, steps=5)
    got = instance_metrics(m, m.most_likely_trajectory().numpy(), seeds=SEEDS, samples=5)
    assert "ade_ml_2s_m" in got
    assert "ade_ml_3s_m" not in got
    assert "min_fde_1_m" in got


def test_a_mode_of_no_weight_does_no_harm() -> None:
    m = random_mixture(6, modes=2)
    m = TrajectoryMixture(
        torch.tensor([[0.0, -torch.inf]] * 3, dtype=torch.float64), m.means, m.covariances, m.origin
    )
    got = instance_metrics(m, _truth(m), [ROAD] * 3, SEEDS, samples=5)
    for name, values in got.items():
        assert np.isfinite(values).all(), name


def test_merged_figures_are_those_of_each_agents_own_merged_modes() -> None:
    """However many merged modes the others in the batch have."""
    m = random_mixture(8, agents=12, modes=9)
    # From six bundles to one
    m = TrajectoryMixture(m.log_weights, m.means / torch.arange(1, 13)[:, None, None, None], *_rest(m))
    truth = _truth(m)
    got = instance_metrics(m, truth)
    merged = merge_modes(m)
    assert len(set(merged.counts.tolist())) > 2
    for agent, count in enumerate(merged.counts.tolist()):
        modes = merged.mixture.world_means[agent, :count].numpy()[None]
        weights = merged.mixture.weights[agent, :count].numpy()[None]
        here = truth[agent : agent + 1]
        for k in (5, 10):
            for name, figure in (
                (f"merged_min_ade_{k}_m", multimodal.min_ade_m),
                (f"merged_min_fde_{k}_m", multimodal.min_fde_m),
                (f"merged_miss_rate_{k}", multimodal.missed),
                (f"merged_brier_min_fde_{k}_m", multimodal.brier_min_fde_m),
            ):
                np.testing.assert_allclose(got[name][agent], figure(modes, weights, here, k), err_msg=name)
        assert got["merged_modes_90"][agent] == multimodal.modes_holding(weights, 0.9)
        assert got["merged_first_weight"][agent] == weights.max()
        likeliest = displacement.displacement_m(modes[0, weights[0].argmax()], here[0])
        np.testing.assert_allclose(got["fde_merged_6s_m"][agent], likeliest[-1])
        np.testing.assert_allclose(got["ade_merged_3s_m"][agent], likeliest[:6].mean())


def _rest(m: TrajectoryMixture) -> tuple[torch.Tensor, torch.Tensor]:
    return m.covariances, m.origin


def test_figures_without_those_that_stood() -> None:
    m = random_mixture(9)
    truth = _truth(m)
    plain = instance_metrics(m, truth, [ROAD] * 3, SEEDS, samples=5)
    got = instance_metrics(m, truth, [ROAD] * 3, SEEDS, samples=5, stood=np.array([False, True, False]))
    assert set(got) - set(plain) == {f"{MOVING}{name}" for name in MOVING_FIGURES}
    for name in MOVING_FIGURES:
        np.testing.assert_array_equal(got[f"{MOVING}{name}"], np.where([0, 1, 0], np.nan, plain[name]), name)
    few = instance_metrics(m, truth, stood=np.zeros(3, dtype=np.bool_))
    assert "moving_off_road_f" not in few
    with pytest.raises(ValueError, match="stood"):
        instance_metrics(m, truth, stood=np.zeros(2, dtype=np.bool_))


def test_sizes_must_fit() -> None:
    m = random_mixture(7)
    truth = _truth(m)
    for arguments in ((m, truth[:2]), (m, truth[:, :3]), (m, truth, None, [1]), (m[:0], truth[:0])):
        with pytest.raises(ValueError, match=r"truth|seeds|no instances"):
            instance_metrics(*arguments)
    with pytest.raises(ValueError, match="rasters"):
        instance_metrics(m, truth, [ROAD])


def test_weight_that_leaves_is_that_of_modes_beyond_two_metres_after_three_seconds() -> None:
    means = torch.zeros(1, 3, 12, 2)
    means[0, 1, 5, 0], means[0, 2, 5, 1] = 1.99, -2.01
    means[0, 0, 6:] = 50.0  # later than 3 s does not count
    weights = torch.tensor([[0.5, 0.3, 0.2]])
    mixture = TrajectoryMixture(
        weights.log(), means, torch.eye(2).expand(1, 3, 12, 2, 2), torch.full((1, 2), 7.0).double()
    )
    leaving = instance_metrics(mixture, np.zeros((1, 12, 2)))["leaving_weight_3s"]
    np.testing.assert_allclose(leaving, [0.2], atol=1e-6)
