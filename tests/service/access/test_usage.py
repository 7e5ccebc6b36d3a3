"""Limits of one key."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.access.key_file import Key
from service.access.usage import BURST_SECONDS, Usage
from service.errors import LimitExceeded, TooLarge


def key(
    agents_per_second: float | None = None, concurrent_agents: int | None = None, streams: int | None = None
) -> Key:
    return Key(
        name="k",
        sha256="0" * 64,
        scopes=(),
        agents_per_second=agents_per_second,
        concurrent_agents=concurrent_agents,
        streams=streams,
    )


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_rate() -> None:
    clock = Clock()
    usage = Usage(key(agents_per_second=10), clock)
    usage.take(7)
    with pytest.raises(LimitExceeded, match="10 agents per second") as caught:
        usage.take(5)
    assert caught.value.retry_after == pytest.approx(0.2)
    clock.now += 0.2
    usage.take(5)
    with pytest.raises(LimitExceeded):
        usage.take(1)


def test_a_request_larger_than_the_rate_waits_for_a_full_bucket_and_leaves_a_debt() -> None:
    clock = Clock()
    usage = Usage(key(agents_per_second=10), clock)
    usage.take(30)
    with pytest.raises(LimitExceeded) as caught:
        usage.take(1)
    assert caught.value.retry_after == pytest.approx(2.1)
    clock.now += 2.5
    with pytest.raises(LimitExceeded) as caught:
        usage.take(30)
    assert caught.value.retry_after == pytest.approx(0.5)
    clock.now += 0.5
    usage.take(30)


def test_agents_that_were_taken_on_arrival_are_not_taken_twice() -> None:
    usage = Usage(key(agents_per_second=10), Clock())
    usage.take(1)
    usage.take(10, refund=1)
    with pytest.raises(LimitExceeded):
        usage.take(1)


@given(
    rate=st.floats(0.5, 1000),
    steps=st.lists(st.tuples(st.floats(0, 2), st.integers(1, 300)), max_size=60),
)
def test_no_sequence_of_requests_goes_beyond_the_rate(rate: float, steps: list[tuple[float, int]]) -> None:
    clock = Clock()
    usage = Usage(key(agents_per_second=rate), clock)
    accepted = last = 0
    for seconds, agents in steps:
        clock.now += seconds
        try:
            usage.take(agents)
        except LimitExceeded:
            continue
        accepted, last = accepted + agents, agents
    burst = max(rate * BURST_SECONDS, 1)
    # The last request may be larger than what the bucket held; the next one would pay for it.
    assert accepted - last <= burst + rate * (clock.now - 100) + 1e-6


def test_agents_in_progress() -> None:
    usage = Usage(key(concurrent_agents=4))
    usage.hold(1)
    usage.hold(3, held=1)
    usage.hold(1)
    with pytest.raises(LimitExceeded, match="4 agents of the key are in progress; at most 4"):
        usage.hold(1)
    with pytest.raises(TooLarge, match="5 agents; the key may have 4"):
        usage.hold(5, held=1)
    assert usage.agents == 4


def test_streams() -> None:
    usage = Usage(key(streams=1))
    usage.open_stream()
    with pytest.raises(LimitExceeded):
        usage.open_stream()
    usage.streams -= 1
    usage.open_stream()


def test_without_limits() -> None:
    usage = Usage(key())
    for _ in range(100):
        usage.take(10_000)
        usage.hold(10_000)
        usage.open_stream()


def test_changed_limits_take_effect_on_what_is_in_progress() -> None:
    clock = Clock()
    usage = Usage(key(agents_per_second=1000, concurrent_agents=10), clock)
    usage.hold(5)
    usage.change(key(agents_per_second=10, concurrent_agents=5))
    with pytest.raises(LimitExceeded):
        usage.hold(1)
    usage.take(10)
    with pytest.raises(LimitExceeded):
        usage.take(1)
