"""Table 1 of Ben-Younes et al. 2022 (arXiv 2109.08048), to stand beside our figures.

Its states are those of the paper protocol, and its pairs those of the paper's own split.
"""

from collections.abc import Mapping
from dataclasses import dataclass

Horizons = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Published:
    """A row of the table."""

    ade_ml_m: Horizons
    """At 1 … 6 s."""
    fde_ml_m: Horizons
    """At 1 … 6 s."""
    off_road_ml: float
    sampled: tuple[float, float, float] | None = None
    """ADE-f and FDE-f at 6 s, m, and OffR-f, of 2000 samples; None: not tabulated."""

    def figures(self) -> dict[str, float]:
        """By the names of ``model.metrics.evaluate``."""
        figures = {f"ade_ml_{second}s_m": value for second, value in enumerate(self.ade_ml_m, start=1)}
        figures |= {f"fde_ml_{second}s_m": value for second, value in enumerate(self.fde_ml_m, start=1)}
        figures["off_road_ml"] = self.off_road_ml
        if self.sampled is not None:
            figures |= dict(zip(("ade_f_6s_m", "fde_f_6s_m", "off_road_f"), self.sampled, strict=True))
        return figures


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
"""By our names of the models."""
