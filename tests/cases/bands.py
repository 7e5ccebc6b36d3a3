"""Readings of a forecast for each kind of case, and the bands in which a planner expects them."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from cab_forecast import Status
from tests.cases import checks
from tests.cases.case import Case, Row
from tests.cases.checks import LocalForecast, step

HORIZON = 6.0
"""s."""
_COVERNET = "covernet"
_COVERNET_TOLERANCE = 2.0
"""m; CoverNet's trajectory set covers the recorded trajectories to within this distance."""


@dataclass(frozen=True)
class Reading:
    """A quantity and its band; NaN, a quantity without a value, is in every band."""

    what: str
    value: float
    low: float = -math.inf
    high: float = math.inf

    @property
    def judged(self) -> bool:
        """Return whether there is a band."""
        return self.low > -math.inf or self.high < math.inf

    @property
    def ok(self) -> bool:
        """Return whether the value lies in its band."""
        return math.isnan(self.value) or self.low <= self.value <= self.high

    @property
    def band(self) -> str:
        """Return the band as text."""
        if self.low > -math.inf and self.high < math.inf:
            return f"{self.low:.3g} … {self.high:.3g}"
        if self.judged:
            return f"≥ {self.low:.3g}" if self.low > -math.inf else f"≤ {self.high:.3g}"
        return "–"

    def __str__(self) -> str:
        return f"{self.what} {self.value:.3g} ({self.band})"


def readings(
    case: Case, forecast: LocalForecast, companion: LocalForecast | None = None, model: str = ""
) -> list[Reading]:
    """Return the readings of a forecast for the row of its case.

    Args:
        case: the case.
        forecast: the forecast of its car.
        companion: the forecast of the case that ``facts.companion`` names.
        model: the model's name; CoverNet's tolerances are wider.
    """
    slack = _COVERNET_TOLERANCE if model == _COVERNET else 0.0
    return list(_ROWS[case.row](case, forecast, companion, slack))


def widths(forecast: LocalForecast) -> list[Reading]:
    """Return the readings of standard deviations, which every case has."""
    return [
        Reading("narrow σ at 1 s", checks.narrow_sigma(forecast, 1.0), low=0.1 - 1e-6),
        Reading("narrow σ at 6 s", checks.narrow_sigma(forecast, HORIZON), low=0.3 - 1e-6),
    ]


def few_modes(forecast: LocalForecast) -> list[Reading]:
    """Return the readings of the number of modes, which every case has."""
    return [
        Reading("modes for 90 %", checks.modes_for(forecast.weights, 0.9)),
        Reading("merged modes for 90 %", checks.merged_modes_for(forecast, 0.9), high=6),
    ]


_Judge = Callable[[Case, LocalForecast, LocalForecast | None, float], Iterator[Reading]]


def _standing(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    yield Reading("moves > 2 m in 3 s", checks.share_moving(forecast, 2.0, 3.0), high=0.2)
    yield Reading("ML from start at 3 s", _distance(forecast, 3.0), high=1.0 + slack)
    yield Reading("ML from start at 6 s", _distance(forecast, HORIZON))
    if case.facts.oriented:
        ahead = checks.share_of_moving_ahead(forecast, 2.0, 3.0, math.radians(60))
        yield Reading("of that within 60°", ahead, low=0.95)
        modes = checks.weight_of_moving_ahead(forecast, 2.0, 3.0, math.radians(60))
        yield Reading("of moving modes within 60°", modes)


def _sideways(
    case: Case, forecast: LocalForecast, companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    yield from _standing(case, forecast, companion, slack)
    yield Reading("sideways > 3 m", checks.share_sideways(forecast, 3.0), high=0.02)


def _parked(
    _case: Case, forecast: LocalForecast, _companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    yield Reading("moves > 5 m in 6 s", checks.share_moving(forecast, 5.0, HORIZON), high=0.15)
    yield Reading("ML from start at 6 s", _distance(forecast, HORIZON), high=1.0 + slack)


def _creeping(
    _case: Case, forecast: LocalForecast, _companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    yield Reading("ML along", forecast.likeliest[-1, 0], -slack, 12.0 + slack)
    yield Reading("ML sideways", abs(forecast.likeliest[-1, 1]))


def _flip(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    far = HORIZON * case.facts.speed / 60
    yield Reading("ML along", forecast.likeliest[-1, 0], 48 * far - slack, 68 * far + slack)
    yield Reading("ML sideways", abs(forecast.likeliest[-1, 1]), high=2.0 + slack)


def _reverse(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    fast = -case.facts.speed / 2
    behind = -forecast.likeliest[:, 0]
    yield Reading("ML behind at 3 s", behind[step(3.0)], 2.5 * fast - slack, 8 * fast + slack)
    yield Reading("ML behind at 6 s", behind[-1], 2 * fast - slack, 15 * fast + slack)
    yield Reading("weight ahead", checks.weight_ahead(forecast), high=0.5)


def _straight(
    case: Case, forecast: LocalForecast, companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    far = HORIZON * case.facts.speed / 60
    end = forecast.likeliest[-1]
    yield Reading("ML along", end[0], 50 * far - slack, 66 * far + slack)
    yield Reading("ML sideways", abs(end[1]), high=(1.5 if case.facts.noisy else 0.5) + slack)
    if companion is not None:
        gap = float(np.linalg.norm(end - companion.likeliest[-1]))
        yield Reading("ML from the clean one's", gap, high=4.0 + slack)


def _noisy_headings(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    yield Reading("ML along", forecast.likeliest[-1, 0])
    yield Reading("ML sideways", abs(forecast.likeliest[-1, 1]), high=2.0 + slack)
    if case.raster is not None:
        yield Reading("weight on the road", checks.weight_on_road(forecast, case.raster))


def _highway(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    way = HORIZON * case.facts.speed
    reach = 0.05 * way + slack
    yield Reading("ML along", forecast.likeliest[-1, 0], way - reach, way + reach)
    yield Reading("ML sideways", abs(forecast.likeliest[-1, 1]), high=1.5 + slack)


def _accelerating(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    steady = HORIZON * case.facts.speed
    whole = steady + case.facts.acceleration * HORIZON**2 / 2
    low, high = checks.middle_along(forecast, 0.9)
    yield Reading("ML along", forecast.likeliest[-1, 0], steady + 4 - slack, whole + 2 + slack)
    yield Reading("middle 90 % from", low, high=whole)
    yield Reading("middle 90 % to", high, low=whole)


def _braking(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    stop = case.facts.speed**2 / (-2 * case.facts.acceleration)
    far = case.facts.speed / 5.5
    yield Reading("ML along", forecast.likeliest[-1, 0], stop - 1 - slack, 25 * far + slack)
    yield Reading(f"ends within {stop + 4:.1f} m", checks.share_within(forecast, stop + 4), low=0.1)


def _road(case: Case, forecast: LocalForecast, least: float) -> Iterator[Reading]:
    if case.raster is None:
        raise ValueError(f"{case.name} needs a raster to be judged by")
    yield Reading("weight on the road", checks.weight_on_road(forecast, case.raster), low=least)
    yield Reading("samples on the road", checks.share_on_road(forecast, case.raster))


def _curve(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, _slack: float
) -> Iterator[Reading]:
    yield from _road(case, forecast, 0.6)


def _junction(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, _slack: float
) -> Iterator[Reading]:
    left, right = checks.share_turning(forecast, math.radians(30))
    yield Reading("samples > 30° left", left)
    yield Reading("samples > 30° right", right)
    left, right = checks.weight_turning(forecast, math.radians(30))
    yield Reading("weight > 30° left", left, low=0.05)
    yield Reading("weight > 30° right", right, low=0.05)
    yield from _road(case, forecast, 0.8)


def _left_turn(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, _slack: float
) -> Iterator[Reading]:
    beyond = math.radians(45)
    turned = checks.weight_turning(forecast, beyond, case.facts.turned)[0]
    yield Reading("weight > 45° left, as it came", turned, low=0.7)
    yield Reading("weight > 45° left, as it looks", checks.weight_turning(forecast, beyond)[0])
    yield from _road(case, forecast, 0.6)


def _lead(
    case: Case, forecast: LocalForecast, _companion: LocalForecast | None, _slack: float
) -> Iterator[Reading]:
    if case.lead is None:
        raise ValueError(f"{case.name} has no lead")
    yield Reading("samples into the lead", checks.share_entering(forecast, case.lead), high=0.4)
    wide = checks.share_entering(forecast, case.lead, checks.CAR_HALF_WIDTH)
    yield Reading("the car's width counted", wide)
    yield Reading("ML along", forecast.likeliest[-1, 0])


def _short(
    case: Case, forecast: LocalForecast, companion: LocalForecast | None, slack: float
) -> Iterator[Reading]:
    far = HORIZON * case.facts.speed / 60
    end = forecast.likeliest[-1]
    said = forecast.status in (Status.SHORT_HISTORY, Status.FALLBACK)
    yield Reading("said to be short or to fall back", float(said), low=1.0)
    yield Reading("said to be short", float(forecast.status is Status.SHORT_HISTORY))
    yield Reading("ML along", end[0], 45 * far - slack, 75 * far + slack)
    yield Reading("ML sideways", abs(end[1]), high=4.0 + slack)
    if companion is not None:
        wider = checks.likeliest_sigma(forecast) / checks.likeliest_sigma(companion)
        yield Reading("σ of ML against full history", wider, low=1.0 + 1e-9)
        wider = checks.mixture_sigma(forecast) / checks.mixture_sigma(companion)
        yield Reading("σ of all against full history", wider, low=1.0 + 1e-9)


def _distance(forecast: LocalForecast, seconds: float) -> float:
    """Return the distance of the most likely mode from the start after ``seconds``, m."""
    return float(np.linalg.norm(forecast.likeliest[step(seconds)]))


_ROWS: dict[Row, _Judge] = {
    Row.STANDING: _standing,
    Row.SIDEWAYS: _sideways,
    Row.PARKED: _parked,
    Row.CREEPING: _creeping,
    Row.FLIP: _flip,
    Row.REVERSE: _reverse,
    Row.STRAIGHT: _straight,
    Row.NOISY_HEADINGS: _noisy_headings,
    Row.HIGHWAY: _highway,
    Row.ACCELERATING: _accelerating,
    Row.BRAKING: _braking,
    Row.CURVE: _curve,
    Row.JUNCTION: _junction,
    Row.LEFT_TURN: _left_turn,
    Row.LEAD: _lead,
    Row.SHORT: _short,
}
