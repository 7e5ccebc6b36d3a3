"""The circuit breaker, by a clock that stands still."""

import pytest

from service.tracking.store.circuit_breaker import Circuit


class Clock:
    """Shows what it is told."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def circuit(clock: Clock) -> Circuit:
    return Circuit(failures=3, pause_s=0.25, max_pause_s=2.0, clock=clock)


def call(circuit: Circuit, success: bool) -> None:
    """A call that ends before anything else happens."""
    assert circuit.ready
    circuit.end(circuit.begin(), success)


def test_it_opens_after_failures_in_a_row(circuit: Circuit) -> None:
    for success in (False, False, True, False, False, True):
        call(circuit, success)
    for _ in range(3):
        call(circuit, False)
    assert not circuit.ready


def test_one_call_decides_after_the_pause(circuit: Circuit, clock: Clock) -> None:
    for _ in range(3):
        call(circuit, False)
    clock.now += 0.2499
    assert not circuit.ready
    clock.now += 0.0001
    assert circuit.ready
    probe = circuit.begin()
    assert probe
    assert not circuit.ready
    clock.now += 1000
    assert not circuit.ready
    circuit.end(probe, True)
    assert circuit.ready
    assert not circuit.begin()


def test_pauses_double_up_to_the_longest_and_begin_anew(circuit: Circuit, clock: Clock) -> None:
    for _ in range(3):
        call(circuit, False)
    for pause in (0.25, 0.5, 1.0, 2.0, 2.0):
        clock.now += pause - 0.0001
        assert not circuit.ready
        clock.now += 0.0001
        call(circuit, False)
    clock.now += 2.0
    call(circuit, True)
    for _ in range(3):
        call(circuit, False)
    clock.now += 0.25
    assert circuit.ready


def test_calls_from_before_it_opened_decide_nothing(circuit: Circuit, clock: Clock) -> None:
    old = [circuit.begin() for _ in range(6)]
    for probe in old[:3]:
        circuit.end(probe, False)
    clock.now += 0.2
    circuit.end(old[3], False)
    circuit.end(old[4], True)
    assert not circuit.ready
    clock.now += 0.05
    probe = circuit.begin()
    circuit.end(old[5], True)
    assert probe
    assert not circuit.ready
