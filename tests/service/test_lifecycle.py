"""Phases of a server and the calls in progress."""

import asyncio

import pytest

from service.errors import Unavailable
from service.lifecycle import Lifecycle, Phase


def test_calls_are_accepted_only_while_ready() -> None:
    lifecycle = Lifecycle()
    with pytest.raises(Unavailable, match="starting"):
        lifecycle.require_ready()
    lifecycle.set_ready()
    lifecycle.require_ready()
    lifecycle.refuse()
    with pytest.raises(Unavailable, match="draining"):
        lifecycle.require_ready()


def test_a_server_that_drains_does_not_become_ready() -> None:
    lifecycle = Lifecycle()
    lifecycle.refuse()
    lifecycle.set_ready()
    assert lifecycle.phase is Phase.DRAINING


async def test_a_drain_waits_for_every_call() -> None:
    lifecycle = Lifecycle()
    assert await lifecycle.wait_idle(0.0)
    first, second = lifecycle.in_progress(), lifecycle.in_progress()
    with first:
        with second:
            assert lifecycle.calls == 2
        waiting = asyncio.create_task(lifecycle.wait_idle(30.0))
        await asyncio.sleep(0.01)
        assert not waiting.done()
        assert not await lifecycle.wait_idle(0.01)
    assert await waiting
    assert lifecycle.calls == 0


async def test_a_call_that_fails_ends_as_well() -> None:
    lifecycle = Lifecycle()
    with pytest.raises(ValueError, match="failed"), lifecycle.in_progress():
        raise ValueError("failed")
    assert await lifecycle.wait_idle(0.0)
