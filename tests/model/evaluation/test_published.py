import pytest

from benchmark.evaluate import CONSISTENCY
from model.evaluation.published import (
    PUBLISHED,
    PUBLISHED_CONSISTENCY,
    PUBLISHED_HARD_CASES,
    published_figures,
)


def test_all_tables_by_the_names_of_the_metrics() -> None:
    cab = published_figures("cab")
    assert (cab["ade_ml_1s_m"], cab["fde_ml_6s_m"], cab["off_road_ml"]) == (0.12, 8.02, 0.13)
    assert [cab[f"convergence_{metres}m_s"] for metres in ("0.2", "1", "5")] == [1.12, 2.45, 4.74]
    assert [cab[f"fde_hardest_{share}_m"] for share in (1, 2, 3, "all")] == [12.13, 11.88, 11.59, 8.02]
    assert len(cab) == 12 + 1 + 3 + 5 + 4


def test_the_papers_dispersion_stands_beside_both_forms_it_may_have() -> None:
    figures = PUBLISHED_CONSISTENCY["covernet"].figures()
    assert figures["dispersion_std_m"] == figures["dispersion_mean_m"] == 4.06
    assert figures.keys() == set(CONSISTENCY) - {"dispersion_rms_m"}


def test_a_model_has_what_the_paper_has_of_it() -> None:
    assert published_figures("kalman") == {}
    assert "ade_ml_6s_m" not in published_figures("constant-acceleration-yaw")
    assert published_figures("constant-acceleration-yaw")["convergence_5m_s"] == 3.30
    assert "fde_hardest_1_m" not in published_figures("halentnet-no-context")


@pytest.mark.parametrize("name", PUBLISHED_CONSISTENCY)
def test_a_wider_range_is_reached_earlier(name: str) -> None:
    converged = PUBLISHED_CONSISTENCY[name].convergence_s
    assert converged == tuple(sorted(converged))
    assert 0 < converged[0] < converged[-1] < 6


@pytest.mark.parametrize("name", PUBLISHED_HARD_CASES)
def test_tables_1_and_3_agree_on_all_pairs(name: str) -> None:
    hard = PUBLISHED_HARD_CASES[name].fde_6s_m
    assert hard == tuple(sorted(hard, reverse=True))
    assert hard[-1] == PUBLISHED[name].figures()["fde_ml_6s_m"]
