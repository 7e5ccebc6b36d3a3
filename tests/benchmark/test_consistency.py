"""Dispersion and convergence of one scene's agents, by hand."""

import numpy as np

from benchmark.evaluate import CONSISTENCY, consistency_metrics
from model.data.scenes import SceneRecord
from tests.model.data.records import raster, track

AGES = np.arange(1, 13)


def straight(frames: int = 20) -> SceneRecord:
    """One agent that goes 1 m a frame."""
    points = np.stack([np.arange(frames, dtype=float), np.zeros(frames)], axis=-1)
    return SceneRecord("scene-1", [track("a", points)], [], raster())


def test_true_forecasts_agree_and_converge_at_once() -> None:
    record = straight()
    made = np.arange(4, 20)
    paths = np.stack([np.stack([frame + AGES, np.zeros(12)], axis=-1) for frame in made]).astype(float)
    found = consistency_metrics(record, {0: (made, paths)})
    assert set(found) == set(CONSISTENCY)
    # Frames 16 … 19 have a forecast of every age
    for name in CONSISTENCY:
        assert found[name].shape == (4,)
        wanted = 6.0 if name.startswith("convergence") else 0.0
        np.testing.assert_allclose(found[name], wanted, atol=1e-12)


def test_forecasts_that_are_off_by_their_age() -> None:
    """Each is 0.1 m to the left a step ahead: within 0.2 m up to age 2, within 1 m up to 10, 5 m always."""
    record = straight()
    made = np.arange(4, 20)
    paths = np.stack([np.stack([frame + AGES, 0.1 * AGES], axis=-1) for frame in made])
    found = consistency_metrics(record, {0: (made, paths)})
    np.testing.assert_allclose(found["convergence_0.2m_s"], 1.0)
    np.testing.assert_allclose(found["convergence_1m_s"], 5.0)
    np.testing.assert_allclose(found["convergence_5m_s"], 6.0)
    distances = np.abs(0.1 * AGES - 0.65)  # 6.5 steps on the mean
    np.testing.assert_allclose(found["dispersion_std_m"], distances.std())
    np.testing.assert_allclose(found["dispersion_mean_m"], distances.mean())
    np.testing.assert_allclose(found["dispersion_rms_m"], np.sqrt((distances**2).mean()))


def test_an_instant_without_every_age_does_not_count() -> None:
    record = straight()
    made = np.delete(np.arange(4, 20), 5)  # none was made at frame 9
    paths = np.zeros((len(made), 12, 2))
    assert all(
        not len(values) for values in consistency_metrics(record, {0: (made[:10], paths[:10])}).values()
    )
    assert len(consistency_metrics(record, {0: (made, paths)})["dispersion_std_m"]) == 0
    assert len(consistency_metrics(record, {})["dispersion_std_m"]) == 0
