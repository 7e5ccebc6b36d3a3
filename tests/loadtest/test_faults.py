"""Rows of the fault matrix on a real server, briefly."""

from collections import Counter

from loadtest import faults
from loadtest.faults import FAULTS, Fault, Row, Victim


def test_faults_are_seen_as_the_matrix_says_and_pass() -> None:
    # The other cores run tests, so an answer may take seconds: its code is what counts here
    rows = faults.run(1.0, FAULTS[1:3], timeout=5.0)
    assert [row.fault.name for row in rows] == ["out of descriptors", "corrupt checkpoint"]
    assert [problem for row in rows for problem in row.problems()] == []
    assert all(row.kept["OK"] > 3 for row in rows)


def test_what_must_not_be_is_told() -> None:
    fault = Fault("flood", Victim.do_nothing, Victim.do_nothing, frozenset(("UNAVAILABLE",)))
    assert Row(fault, Counter(OK=3), Counter(OK=1, UNAVAILABLE=1), 0.1).problems() == []
    assert Row(fault, Counter(OK=3), Counter(OK=2), 0.1).problems() == [
        "flood: nobody noticed, so the fault was none"
    ]
    assert Row(fault, Counter(UNAVAILABLE=1), Counter(INTERNAL=1, UNAVAILABLE=1), None).problems() == [
        "flood: a new caller got INTERNAL",
        "flood: an open connection got UNAVAILABLE",
        "flood: the server did not recover",
    ]
