"""Tables 1 to 3 of Ben-Younes et al. 2022 (arXiv 2109.08048), for comparison with our figures.

The paper's inputs follow the paper protocol, on the paper's own split. Models and metrics have our names.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from model.metrics.consistency import RANGES_M
from model.metrics.hard import HARD_SHARES

Horizons = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Published:
    """A row of table 1: displacement errors and the driveable area."""

    ade_ml_m: Horizons
    """Errors at 1 … 6 s."""
    fde_ml_m: Horizons
    """Errors at 1 … 6 s."""
    off_road_ml: float
    sampled: tuple[float, float, float] | None = None
    """ADE-f and FDE-f at 6 s, m, and OffR-f, of 2000 samples; None: not tabulated."""

    def figures(self) -> dict[str, float]:
        """Return the figures by the names of ``model.metrics.evaluate``."""
        figures = {f"ade_ml_{second}s_m": value for second, value in enumerate(self.ade_ml_m, start=1)}
        figures |= {f"fde_ml_{second}s_m": value for second, value in enumerate(self.fde_ml_m, start=1)}
        figures["off_road_ml"] = self.off_road_ml
        if self.sampled is not None:
            figures |= dict(zip(("ade_f_6s_m", "fde_f_6s_m", "off_road_f"), self.sampled, strict=True))
        return figures


@dataclass(frozen=True)
class PublishedConsistency:
    """A row of table 2: temporal consistency of the forecasts."""

    dispersion_m: float
    """D."""
    convergence_s: tuple[float, float, float]
    """C(0.2 m), C(1 m) and C(5 m)."""

    def figures(self) -> dict[str, float]:
        """Return the figures by the names of ``benchmark.evaluate.CONSISTENCY``.

        D is returned under two names: the paper's formula is the standard deviation, but its figures fit the
        mean distance better (REFERENCE.md section 4).
        """
        names = [f"convergence_{range_m:g}m_s" for range_m in RANGES_M]
        figures = dict.fromkeys(("dispersion_std_m", "dispersion_mean_m"), self.dispersion_m)
        return figures | dict(zip(names, self.convergence_s, strict=True))


@dataclass(frozen=True)
class PublishedHardCases:
    """A row of table 3: the pairs with the largest errors of the Kalman filter."""

    fde_6s_m: tuple[float, float, float, float]
    """Errors on the hardest 1, 2 and 3 % of the pairs, and on all."""

    def figures(self) -> dict[str, float]:
        """Return the figures by the names of ``benchmark.hard_cases.hardest_fde``."""
        names = [*(f"fde_hardest_{round(100 * share)}_m" for share in HARD_SHARES), "fde_hardest_all_m"]
        return dict(zip(names, self.fde_6s_m, strict=True))


PUBLISHED: Mapping[str, Published] = {
    "constant-velocity-yaw": Published(
        (0.46, 0.94, 1.61, 2.44, 3.45, 4.61), (0.64, 1.74, 3.37, 5.53, 8.16, 11.21), 0.14
    ),
    "physics-oracle": Published(
        (0.43, 0.82, 1.33, 1.98, 2.76, 3.70), (0.59, 1.45, 2.69, 4.35, 6.47, 9.09), 0.12
    ),
    "covernet": Published((0.81, 1.41, 2.11, 2.93, 3.88, 4.93), (1.07, 2.35, 3.92, 5.90, 8.30, 10.84), 0.11),
    "trajectron-no-context": Published(
        (0.13, 0.39, 0.87, 1.59, 2.56, 3.80), (0.15, 0.86, 2.23, 4.32, 7.22, 10.94), 0.27, (4.46, 12.32, 0.36)
    ),
    "trajectron": Published(
        (0.13, 0.39, 0.86, 1.55, 2.47, 3.65), (0.15, 0.87, 2.16, 4.15, 6.92, 10.45), 0.23, (4.15, 11.44, 0.29)
    ),
    "halentnet-no-context": Published(
        (0.12, 0.38, 0.82, 1.43, 2.21, 3.17), (0.13, 0.85, 2.04, 3.72, 5.92, 8.64), 0.27, (4.13, 10.95, 0.29)
    ),
    "halentnet": Published(
        (0.14, 0.41, 0.87, 1.51, 2.32, 3.29), (0.17, 0.88, 2.14, 3.91, 6.15, 8.83), 0.28, (3.98, 10.61, 0.25)
    ),
    "reweight": Published(
        (0.13, 0.38, 0.81, 1.42, 2.20, 3.14), (0.15, 0.83, 2.00, 3.69, 5.90, 8.58), 0.17, (3.71, 9.74, 0.19)
    ),
    "rubiz": Published(
        (0.18, 0.42, 0.82, 1.40, 2.14, 3.04), (0.23, 0.84, 1.95, 3.55, 5.65, 8.21), 0.11, (3.68, 9.45, 0.17)
    ),
    "cab": Published(
        (0.12, 0.34, 0.73, 1.29, 2.01, 2.90), (0.14, 0.73, 1.81, 3.39, 5.47, 8.02), 0.13, (3.41, 9.03, 0.20)
    ),
}
"""Table 1."""

PUBLISHED_CONSISTENCY: Mapping[str, PublishedConsistency] = {
    "constant-acceleration-yaw": PublishedConsistency(6.55, (0.44, 1.49, 3.30)),
    "constant-acceleration-yaw-rate": PublishedConsistency(6.03, (0.47, 1.58, 3.46)),
    "constant-speed-yaw-rate": PublishedConsistency(3.42, (0.54, 1.82, 4.15)),
    "constant-velocity-yaw": PublishedConsistency(3.33, (0.53, 1.82, 4.16)),
    "physics-oracle": PublishedConsistency(2.99, (0.55, 1.91, 4.38)),
    "covernet": PublishedConsistency(4.06, (0.15, 0.93, 3.50)),
    "trajectron-no-context": PublishedConsistency(3.65, (1.00, 2.11, 4.17)),
    "trajectron": PublishedConsistency(3.55, (0.98, 2.11, 4.22)),
    "halentnet-no-context": PublishedConsistency(2.85, (1.03, 2.28, 4.59)),
    "halentnet": PublishedConsistency(3.23, (0.90, 2.07, 4.26)),
    "reweight": PublishedConsistency(3.02, (1.03, 2.27, 4.50)),
    "rubiz": PublishedConsistency(2.73, (0.94, 2.31, 4.60)),
    "cab": PublishedConsistency(2.61, (1.12, 2.45, 4.74)),
}
"""Table 2."""

PUBLISHED_HARD_CASES: Mapping[str, PublishedHardCases] = {
    "trajectron-no-context": PublishedHardCases((15.80, 15.58, 14.97, 10.94)),
    "trajectron": PublishedHardCases((13.12, 12.69, 12.25, 10.45)),
    "halentnet": PublishedHardCases((14.12, 12.83, 12.09, 8.83)),
    "reweight": PublishedHardCases((14.00, 13.30, 12.58, 8.58)),
    "rubiz": PublishedHardCases((13.42, 12.49, 11.64, 8.21)),
    "cab": PublishedHardCases((12.13, 11.88, 11.59, 8.02)),
}
"""Table 3."""


def published_figures(model: str) -> dict[str, float]:
    """Return all figures of the paper for a model, by the names of the metrics; empty if it has none."""
    tables = (PUBLISHED, PUBLISHED_CONSISTENCY, PUBLISHED_HARD_CASES)
    figures: dict[str, float] = {}
    for table in tables:
        if model in table:
            figures |= table[model].figures()
    return figures
