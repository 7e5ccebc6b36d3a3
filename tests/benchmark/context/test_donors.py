"""The choice of donors, on scenes of agents that wander about."""

import numpy as np
import pytest

from benchmark.context.cases import SHIFT_M, TURN, Cases, Change
from benchmark.context.donors import DonorPool
from benchmark.context.moves import Move
from benchmark.plan import PlannedScene, plan_scenes
from model.explanation.matching import LENGTH_M, LIKE_SPEED, NEIGHBORS_M, WIDTH_M
from model.geometry import rotate
from model.metrics.offroad import driveable
from tests.model.data.records import FixedReader, record

SCENES: list[PlannedScene] = list(
    plan_scenes(FixedReader(*(record(f"scene-{seed}", seed) for seed in range(8))), "some", consistency=False)
)
PAIRS = sum(len(scene.pairs) for scene in SCENES)


@pytest.fixture(scope="module")
def pool() -> DonorPool:
    return DonorPool(SCENES, seed=0)


def test_donors_of_maps_are_alike_and_from_other_scenes(pool: DonorPool) -> None:
    found = 0
    for number in range(PAIRS):
        agent = pool.agents[number]
        for index in pool.map_donors(number, 3):
            donor = pool.agents[index]
            found += 1
            assert donor.scene != agent.scene
            assert abs(donor.speed - agent.speed) <= LIKE_SPEED
            past = agent.past[np.isfinite(agent.past).all(axis=1)]
            moved = Move(agent.pose, donor.pose).points(past)
            assert driveable(SCENES[donor.scene].record.raster, moved).all()
    assert found > 50


def test_donors_give_as_many_neighbours_that_do_not_overlap(pool: DonorPool) -> None:
    found = 0
    for number in range(PAIRS):
        agent = pool.agents[number]
        for index, tracks in pool.neighbor_donors(number, 3):
            donor = pool.agents[index]
            found += 1
            assert donor.scene != agent.scene
            assert abs(donor.speed - agent.speed) <= LIKE_SPEED
            assert len(tracks) == len(pool.neighbors(number)) > 0
            assert donor.track not in tracks
            for track in tracks:
                seen = SCENES[donor.scene].record.tracks[track].positions(donor.frame + np.arange(-4, 1))
                offset = rotate(Move(donor.pose, agent.pose).points(seen) - agent.past, -agent.past_heading)
                overlap = (np.abs(offset) < [LENGTH_M, WIDTH_M]).all(axis=1)
                assert not overlap.any()
    assert found > 50


def test_neighbours_are_near_and_seen_twice(pool: DonorPool) -> None:
    for number in range(PAIRS):
        agent = pool.agents[number]
        tracks = SCENES[agent.scene].record.tracks
        expected = [
            index
            for index, track in enumerate(tracks)
            if index != agent.track
            and {agent.frame - 1, agent.frame} <= set(track.frames.tolist())
            and np.linalg.norm(track.positions(np.array(agent.frame)) - agent.pose.position) <= NEIGHBORS_M
        ]
        assert sorted(pool.neighbors(number).tolist()) == expected


def test_the_choice_depends_on_seed_and_pair_alone() -> None:
    one, other, third = DonorPool(SCENES, 0), DonorPool(SCENES, 0), DonorPool(SCENES, 1)
    numbers = list(range(PAIRS))
    chosen = [one.map_donors(number, 2) for number in numbers]
    assert chosen == [other.map_donors(number, 2) for number in reversed(numbers)][::-1]
    assert chosen != [third.map_donors(number, 2) for number in numbers]


def test_a_case_changes_one_part_of_the_context() -> None:
    cases = Cases(SCENES[:3], 1, 0)
    assert len({case.name for case in cases.cases}) == len(cases)
    by_change = {
        change: [i for i, case in enumerate(cases.cases) if case.change is change] for change in Change
    }
    for index in by_change[Change.NEIGHBORS]:
        case, scene = cases.cases[index], cases[index]
        agent = cases.pool.agents[case.number]
        own = SCENES[agent.scene].record
        assert scene.record.raster is own.raster
        assert scene.record.tracks[0] is own.tracks[agent.track]
        donors = [track for track in scene.record.tracks if track.id.startswith("donor-")]
        assert len(donors) == len(cases.pool.neighbors(case.number))
        kept = {track.id for track in scene.record.tracks[1:]} - {track.id for track in donors}
        replaced = {own.tracks[track].id for track in cases.pool.neighbors(case.number)}
        assert not kept & replaced
    for index in by_change[Change.MAP][:20]:
        case, scene = cases.cases[index], cases[index]
        agent = cases.pool.agents[case.number]
        own = SCENES[agent.scene].record
        ids = {track.id for track in own.tracks if agent.frame in track.frames}
        assert {track.id for track in scene.record.tracks} == ids
        (call,) = scene.calls
        assert (call.frame, call.tracks) == (agent.frame, (0,))


def test_the_control_is_the_own_map_a_little_off() -> None:
    cases = Cases(SCENES, 1, 0)
    controls = [case for case in cases.cases if case.change is Change.CONTROL]
    assert len(controls) == PAIRS
    for case in controls:
        agent = cases.pool.agents[case.number]
        assert case.scene == agent.scene
        moved = case.move.points(agent.pose.position)
        assert np.linalg.norm(case.move.source.position - agent.pose.position) == pytest.approx(SHIFT_M)
        assert np.linalg.norm(moved - agent.pose.position) == pytest.approx(SHIFT_M)
        assert abs(case.move.source.heading - agent.pose.heading) == pytest.approx(TURN)


def test_only_cases_without_an_answer_are_left() -> None:
    cases = Cases(SCENES[:2], 1, 0)
    first, *others = cases.cases
    frame = cases.pool.agents[first.number].frame
    left = cases.unanswered({("one", first.name, frame)}, ["one"])
    assert list(left.cases) == others
    assert len(cases.unanswered({("one", first.name, frame)}, ["one", "two"])) == len(cases)
