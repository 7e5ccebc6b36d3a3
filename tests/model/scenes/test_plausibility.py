"""Contradictions in observations: what each check finds, and what it must not find."""

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.arrays import Floats
from model.geometry import rotate
from model.scenes.observations import Observations
from model.scenes.plausibility import Contradiction, find_contradictions
from model.scenes.scene import AgentType, Raster

TIME = 1.7e9


def driving(
    agents: int = 1, rate: float = 2.0, speed: float = 8.0, turn: float = 0.1, acceleration: float = 0.0
) -> Observations:
    """Return 2 s of agents that drive arcs in different directions, with headings and velocities."""
    count = round(2 * rate) + 1
    ages = np.arange(count - 1, -1, -1) / rate
    direction = 0.6 + 1.1 * np.arange(agents)[:, None]
    fine = np.linspace(-2, 0, 2001)
    speeds = np.maximum(speed + acceleration * fine, 0.0)
    step = np.exp(1j * turn * fine) * speeds * (fine[1] - fine[0])
    path = np.cumsum(step) - np.sum(step)
    at = np.searchsorted(fine, -ages - 1e-9)
    moved = path[at] * np.exp(1j * direction) + 100.0 * np.arange(agents)[:, None]
    heading = np.broadcast_to(direction + turn * -ages, moved.shape)
    velocity = speeds[at] * np.exp(1j * heading)
    unknown = np.full(moved.shape, np.nan)
    return Observations(
        count=np.full(agents, count),
        time=np.broadcast_to(TIME - ages, moved.shape).copy(),
        position=np.stack([moved.real, moved.imag], axis=-1),
        heading=heading.copy(),
        velocity=np.stack([velocity.real, velocity.imag], axis=-1),
        acceleration=np.stack([unknown, unknown], axis=-1),
        heading_rate=unknown,
    )


def kinds(
    observations: Observations, kind: AgentType = AgentType.VEHICLE, raster: Raster | None = None
) -> list[Contradiction]:
    """Return the kinds found, of each agent in turn."""
    found = find_contradictions(observations, [kind] * len(observations.count), raster)
    return [finding.kind for finding in sorted(found, key=lambda finding: finding.row)]


@given(
    rate=st.sampled_from([2.0, 5.0, 10.0, 20.0]),
    speed=st.floats(0.0, 35.0),
    turn=st.floats(-0.4, 0.4),
    acceleration=st.floats(-5.0, 3.0),
)
def test_driving_contradicts_nothing(rate: float, speed: float, turn: float, acceleration: float) -> None:
    assert not kinds(driving(3, rate, speed, turn, acceleration))


@given(count=st.integers(1, 5), angle=st.floats(-10.0, 10.0))
def test_what_is_not_given_contradicts_nothing(count: int, angle: float) -> None:
    seen = driving(2)
    part = Observations(**{name: value[:, :count] for name, value in vars(seen).items() if name != "count"},
                        count=np.full(2, count))  # fmt: skip
    bare = replace(
        part, heading=np.full_like(part.heading, np.nan), velocity=np.full_like(part.velocity, np.nan)
    )
    assert not kinds(replace(bare, position=rotate(bare.position, np.full(bare.time.shape, angle))))


@pytest.mark.parametrize("rate", [2.0, 10.0])
@pytest.mark.parametrize(
    ("change", "hint"),
    [
        (lambda v, h: -v, "the sign is wrong"),
        (lambda v, h: 3.6 * v, "it is in km/h"),
        (lambda v, h: v * [1.0, -1.0], "y is mirrored"),
        (lambda v, h: rotate(v, -h), "it is in the agent's frame"),
    ],
)
def test_velocities_off_the_positions(rate: float, change: object, hint: str) -> None:
    seen = driving(1, rate, turn=0.0)
    wrong = change(seen.velocity, seen.heading)  # type: ignore[operator]
    [found] = find_contradictions(replace(seen, velocity=wrong), [AgentType.VEHICLE])
    assert (found.kind, found.value) == (Contradiction.VELOCITY_MISMATCH, "velocity_x")
    assert found.state == seen.count[0] - 1
    assert found.detail.endswith(f"it fits if {hint}")


def test_a_heading_across_the_motion() -> None:
    seen = driving(1)
    wrong = replace(seen, heading=seen.heading + np.pi / 2)
    assert kinds(wrong) == [Contradiction.HEADING_MISMATCH]
    assert not kinds(wrong, AgentType.PEDESTRIAN)  # people step sideways


def test_a_velocity_is_the_motion_of_a_single_state() -> None:
    seen = driving(1)
    single = Observations(
        **{name: value[:, -1:] for name, value in vars(seen).items() if name != "count"},
        count=np.ones(1, int),
    )
    assert not kinds(single)
    assert kinds(replace(single, heading=single.heading + 1.5)) == [Contradiction.HEADING_MISMATCH]


def test_reversing_is_no_contradiction_unless_it_is_fast() -> None:
    for speed, expected in ((2.5, []), (8.0, [Contradiction.HEADING_MISMATCH])):
        seen = driving(1, speed=speed)
        assert kinds(replace(seen, heading=seen.heading + np.pi)) == expected


def test_headings_in_degrees_are_said_of_those_that_stand_too() -> None:
    moving, standing = driving(2), driving(2, speed=0.0)
    both = Observations(
        **{name: np.concatenate([value, getattr(standing, name)]) for name, value in vars(moving).items()}
    )
    assert kinds(both) == []
    right = both.heading.copy()
    assert kinds(replace(both, heading=np.rad2deg(right))) == [Contradiction.HEADING_IN_DEGREES] * 4
    assert Contradiction.HEADING_IN_DEGREES not in kinds(replace(both, heading=right + 40 * np.pi))


@pytest.mark.parametrize(
    ("offset", "reading"), [(0.0, "y is mirrored"), (np.pi / 2, "they are clockwise from the y axis")]
)
def test_clockwise_headings(offset: float, reading: str) -> None:
    seen = driving(4)
    found = find_contradictions(replace(seen, heading=offset - seen.heading), [AgentType.VEHICLE] * 4)
    assert {finding.kind for finding in found} == {Contradiction.HEADING_MIRRORED}
    assert len(found) == 4
    assert found[0].detail.endswith(reading)


@pytest.mark.parametrize("rate", [2.0, 10.0])
@pytest.mark.parametrize("back", [0, 1, 2])
def test_one_flipped_heading(rate: float, back: int) -> None:
    seen = driving(1, rate, speed=0.0)
    seen.heading[0, -1 - back] += np.pi
    [found] = find_contradictions(seen, [AgentType.VEHICLE])
    assert (found.kind, found.value) == (Contradiction.HEADING_FLIPPED, "heading")
    assert found.state == seen.count[0] - 1 - back


@pytest.mark.parametrize("speed", [0.0, 8.0])
def test_an_id_given_to_another_object(speed: float) -> None:
    seen = driving(2, speed=speed, turn=0.0)
    seen.position[0, -1] += [40.0, 0.0]
    [found] = [one for one in find_contradictions(seen, [AgentType.VEHICLE] * 2) if one.value == "x"]
    assert (found.row, found.kind, found.state) == (0, Contradiction.OTHER_OBJECT, 4)
    assert "m in 0.5 s" in found.detail


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]
)
def test_times_in_other_units(factor: float, unit: str) -> None:
    seen = driving(1)
    [found] = find_contradictions(replace(seen, time=(seen.time - TIME) * factor), [AgentType.VEHICLE])
    assert (found.kind, found.value) == (Contradiction.TIME_UNIT, "time")
    assert unit in found.detail


def road(seen: Observations) -> Raster:
    """Return a map that is driveable along the paths of some agents, and not symmetric."""
    layers = np.zeros((3, 400, 600), dtype=np.uint8)
    origin = np.array([-50.0, -60.0])
    points = seen.position.reshape(-1, 2)
    for ahead in np.linspace(0.0, 1.5, 16):
        moved = points + ahead * seen.velocity.reshape(-1, 2)
        rows, columns = np.rint((moved - origin) * 2.0).astype(int).T
        for shift in range(-6, 7):
            layers[0, np.clip(rows + shift, 0, 399), np.clip(columns, 0, 599)] = 1
    return Raster(layers, origin, 2.0)


def spread(agents: int = 4) -> Observations:
    """Return agents that drive apart from each other, all on the map of ``road``."""
    seen = driving(agents, turn=0.0)
    place: Floats = np.array([[0.0, 0.0], [30.0, 20.0], [60.0, 150.0], [110.0, 40.0]])[:agents, None]
    return replace(seen, position=seen.position - seen.position[:, -1:] + place)


@pytest.mark.parametrize(
    ("axes", "hint"),
    [((1,), "rows are reversed"), ((2,), "columns are reversed"), ((1, 2), "rows and columns are reversed")],
)
def test_a_mirrored_map(axes: tuple[int, ...], hint: str) -> None:
    seen = spread()
    raster = road(seen)
    assert not kinds(seen, raster=raster)
    wrong = replace(raster, layers=np.flip(raster.layers, axes))
    found = find_contradictions(seen, [AgentType.VEHICLE] * 4, wrong)
    assert [finding.kind for finding in found] == [Contradiction.OFF_MAP] * 4
    assert found[0].detail.endswith(hint)


def test_a_mirrored_map_that_has_most_vehicles_on_some_road() -> None:
    seen = spread()
    raster = road(seen)
    turned = np.flip(raster.layers, (1, 2)).copy()
    # All paths would be on a road of the wrong map, too, but for the first one near now
    turned[0] |= raster.layers[0]
    [[row, column]] = np.rint((seen.position[:1, -1] - raster.origin) * raster.pixels_per_meter).astype(int)
    turned[0, row - 12 : row + 13, column - 12 : column + 13] = 0
    wrong = replace(raster, layers=turned)
    found = find_contradictions(seen, [AgentType.VEHICLE] * 4, wrong)
    assert [finding.kind for finding in found] == [Contradiction.OFF_MAP] * 4
    assert re.search(r"^(1\d|2[0-5]) % of the paths .* they fit if its ", found[0].detail)
    few = [AgentType.VEHICLE] * 2 + [AgentType.PEDESTRIAN] * 2
    assert not find_contradictions(seen, few, replace(raster, layers=turned))


def test_a_map_elsewhere_and_one_agent_off_the_road() -> None:
    seen = spread()
    raster = road(seen)
    away = replace(raster, origin=raster.origin + 1000.0)
    assert kinds(seen, raster=away) == [Contradiction.OFF_MAP] * 4
    assert not kinds(driving(1, speed=0.0), raster=away)  # nobody moves
    seen.position[0] += [15.0, -15.0]
    assert not kinds(seen, raster=raster)


def test_own_patches_are_compared_in_the_agents_frame() -> None:
    seen = driving(1, turn=0.0)
    patch = np.zeros((3, 100, 100), dtype=np.uint8)
    patch[0, :, 45:56] = 1
    assert not find_contradictions(seen, [AgentType.VEHICLE], patches={0: patch})
    turned = np.ascontiguousarray(patch.transpose(0, 2, 1))
    [found] = find_contradictions(seen, [AgentType.VEHICLE], patches={0: turned})
    assert found.kind is Contradiction.OFF_MAP
