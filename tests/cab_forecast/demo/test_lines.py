"""Lines of the demo's roads."""

import math

import numpy as np
import pytest

from cab_forecast.demo.lines import (
    STEP,
    Aside,
    Line,
    Lines,
    change_over,
    ease,
    fillet,
    polyline,
    quarter_turns,
)

BEND = Line(polyline((-30, 0), fillet((-12, 0), (0, 0), (0, 12)), (0, 30)))


def test_points_are_a_step_apart_without_kinks() -> None:
    apart = np.hypot(*np.diff(BEND.points, axis=0).T)
    assert apart == pytest.approx(STEP, rel=0.02)
    assert np.abs(np.diff(BEND.headings)).max() < 0.06
    assert BEND.headings[[0, -1]] == pytest.approx([0, math.pi / 2], abs=1e-6)
    assert BEND.curvature.max() == pytest.approx(1 / 12, rel=0.1)


def test_a_fillet_touches_both_lines() -> None:
    points = fillet((-20, 0), (0, 0), (0, -8))
    assert points[[0, -1]] == pytest.approx(np.array([[-8, 0], [0, -8]]), abs=1e-9)
    assert np.hypot(*(points - (-8, -8)).T) == pytest.approx(8.0)


def test_places_beside_a_line_are_found_again() -> None:
    aside = Aside(np.array([-1.5]), np.array([0.0]), np.array([math.inf]))
    distances = np.linspace(3.0, BEND.length - 3.0, 30)
    points, headings, ways = Lines([Line([(0, 9), (5, 9)]), BEND]).at(np.array([1]), distances[None], aside)
    along, left = BEND.nearest(points[0])
    assert along == pytest.approx(distances, abs=0.1)
    assert left == pytest.approx(-1.5, abs=0.02)
    # Speed along the line and the way per way give the speed on the ground
    moved = np.hypot(*np.diff(points[0], axis=0).T)
    assert moved == pytest.approx(np.diff(distances) * (ways[0, 1:] + ways[0, :-1]) / 2, rel=0.02)
    assert np.unwrap(headings[0])[-1] == pytest.approx(math.pi / 2, abs=0.01)


def test_a_change_of_lanes_ends_on_the_line_and_turns_the_heading_only_between() -> None:
    aside = Aside(np.array([3.5]), np.array([10.0]), np.array([40.0]))
    distances = np.arange(5.0, 60.0, 0.5)
    points, headings, _ = Lines([Line([(0, 0), (80, 0)])]).at(np.array([0]), distances[None], aside)
    assert points[0, [0, -1], 1] == pytest.approx([3.5, 0.0])
    assert headings[0, [0, -1]] == pytest.approx([0.0, 0.0])
    slopes = np.arctan2(*np.diff(points[0], axis=0).T[::-1])
    assert slopes == pytest.approx((headings[0, 1:] + headings[0, :-1]) / 2, abs=0.01)


def test_a_way_onto_a_line() -> None:
    points = change_over(Line([(0, 0), (50, 0)]), 10.0, -3.0, 20.0)
    assert points[0] == pytest.approx([10, -3])
    assert points[-1] == pytest.approx([50, 0])
    assert ease(np.array([-1.0, 0.0, 0.5, 1.0, 2.0])) == pytest.approx([0, 0, 0.5, 1, 1])


def test_quarter_turns() -> None:
    assert quarter_turns([(1, 2)], 1).tolist() == [[-2, 1]]
    assert quarter_turns([(1, 2)], -1).tolist() == [[2, -1]]
