"""Short forms of the load tests: counts and ratios of a server that forecasts with a filter, no times."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from loadtest.requests import Encoding, Map
from loadtest.results import Result
from loadtest.scenarios import SCENARIOS
from loadtest.session import Options, Session, opened
from loadtest.wire import Transport


@pytest.fixture
def options(tmp_path: Path) -> Options:
    """A calm load for a busy machine."""
    return Options(
        tmp_path,
        "kalman",
        agents=4,
        seconds=1.0,
        rate=20.0,
        peak=40.0,
        peak_seconds=0.1,
        warm_up=0.1,
        deadline=30.0,
        uploads=10,
        half_headers=20,
        readers=5,
        max_slowdown=100.0,
        max_probe_seconds=20.0,
        retry_seconds=120.0,
    )


async def run(session: Session, *names: str, **changes: Any) -> list[Result]:
    """Run scenarios with changed options, and check what holds for all of them."""
    session.options = replace(session.options, **changes)
    session.results.clear()
    for name in names:
        await SCENARIOS[name](session)
    results = [result for result in session.results if result.offered]  # a short ramp begins with nothing
    assert results
    assert not [failure for result in results for failure in result.failures]
    for result in results:
        assert sum(result.counts.values()) == result.offered
        assert result.checked > 0
    return results


async def test_what_is_accepted_is_answered_and_right(options: Options) -> None:
    """One test, so that one server is started."""
    async with opened(options) as session:
        [steady] = await run(session, "steady")
        assert steady.counts == {"in time": 20}
        await run(session, "ramp", "spike", "closed")
        [cancelled] = await run(session, "cancelled")
        assert cancelled.counts["cancelled"] + cancelled.counts["in time"] == 20
        [uploads] = await run(session, "slow-uploads")
        assert uploads.counts == {"in time": 20}

        [readers] = await run(session, "slow-readers")
        assert readers.counts == {"in time": 20}
        await run(session, "neighbour")

        [overload] = await run(session, "overload", rate=None, peak=None, peak_seconds=0.5, deadline=2.0)
        assert overload.counts["in time"] > overload.counts["late"]

        by_digest = replace(options, map=Map.DIGEST, grpc=session.grpc, http=session.http)
        async with opened(by_digest) as guest:
            [steady] = await run(guest, "steady")
            assert steady.counts == {"in time": 20}
            assert len(guest.requests[0].body) < len(guest.requests[0].whole) / 10

        json = replace(options, transport=Transport.REST, encoding=Encoding.JSON)
        async with opened(replace(json, grpc=session.grpc, http=session.http)) as guest:
            [steady] = await run(guest, "steady")
            assert steady.counts == {"in time": 20}
            with pytest.raises(RuntimeError, match="can be restarted"):
                await guest.restart()

        [restarted] = await run(session, "restart", rate=20.0, peak=40.0, deadline=30.0)
        assert restarted.counts == {"in time": 20}
