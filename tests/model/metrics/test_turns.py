import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from model.metrics.turns import turns_after_now


def turns(past: list[float], future: list[float]) -> bool:
    """Return whether one agent with these headings, in degrees, turns after now."""
    return bool(turns_after_now(np.deg2rad([past]), np.deg2rad([future]))[0])


def test_a_turn_after_a_straight_past() -> None:
    assert turns([0, 0, 0, 0, 0], [10, 20, 31])
    assert turns([2, -2, 0, 1, 0], [-10, -31, -31])
    assert not turns([0, 0, 0, 0, 0], [10, 20, 29])


def test_a_turn_that_has_begun_does_not_count() -> None:
    assert not turns([-20, -15, -10, -6, 0], [10, 20, 40])


def test_a_turn_that_is_taken_back_counts() -> None:
    assert turns([0, 0, 0, 0, 0], [20, 40, 0])


def test_frames_that_were_not_seen_do_not_count() -> None:
    nan = float("nan")
    assert turns([nan, nan, nan, 0, 0], [10, 20, 40])
    assert not turns([nan, nan, nan, 0, 0], [nan, nan, nan])


@given(st.floats(-720, 720), st.floats(-90, 90))
def test_the_direction_of_the_frame_does_not_matter(frame: float, turn: float) -> None:
    future = np.linspace(0, turn, 12)
    assert turns([frame] * 5, (frame + future).tolist()) == turns([0] * 5, future.tolist()) or np.isclose(
        abs(turn), 30
    )
