"""Forecasts continue while Redis is killed, full, slow and hanging, and tracking recovers."""

import shutil
from collections import Counter

import pytest

from cab_forecast import Tracking
from loadtest import redis_faults
from loadtest.load import Call
from loadtest.redis_faults import PhaseResult, Report, Resources

_CONNECTIONS = 16
"""The server's setting."""


@pytest.mark.skipif(shutil.which("redis-server") is None, reason="redis-server is not installed")
def test_no_forecast_fails_whatever_becomes_of_redis() -> None:
    report = redis_faults.run(seconds=6.0, rate=40.0, scenes=4, agents=8)

    assert report.problems() == []
    assert not report.logged
    phases = {result.name: result for result in report.phases}
    assert all(result.calls for result in phases.values())

    for name, reason in (
        ("killed", "refused"),
        ("full", "out_of_memory"),
        ("slow", "timeout"),
        ("hanging", "timeout"),
    ):
        assert phases[name].statuses["UNAVAILABLE"], name
        assert phases[name].errors[reason], name
    assert 1 <= phases["started empty"].statuses["RESET"] <= 4  # each scene's memory was lost, and that once
    for name in ("healthy", "freed", "quick again", "awake again"):
        assert not phases[name].statuses["RESET"], name
        assert not phases[name].statuses["NEW"], name

    # A machine that tests run on may be slow, but not by what Redis is waited for without a budget
    added = [result.quantile_ms(0.9) - phases["healthy"].quantile_ms(0.9) for result in phases.values()]
    assert max(added) < 250

    assert report.after.connections <= _CONNECTIONS
    assert report.after.files <= report.before.files + 2


def test_what_must_not_be_is_told() -> None:
    fine = Call(0.0, 0.01, 0, "", Tracking.OK)
    failed = fine._replace(failure="UNAVAILABLE: gone", tracking=Tracking.UNSPECIFIED)
    held = Resources(connections=1, files=20, threads=10, resident=2**20)
    results = [
        PhaseResult("healthy", True, [fine], Counter(), 0.1),
        PhaseResult("killed", False, [fine, failed], Counter(refused=1), None),
        PhaseResult("started empty", True, [fine], Counter(), None),
    ]
    assert Report(results, held, held, []).problems() == [
        "killed: 1 forecasts failed: UNAVAILABLE: gone",
        "started empty: tracking did not recover",
    ]
