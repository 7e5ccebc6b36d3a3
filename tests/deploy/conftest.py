"""Fixtures of the tests of deploy/."""

import asyncio

import pytest

from tests.deploy.files import job_name, rules
from tests.deploy.promql import labels_of
from tests.deploy.series import Series, exported


@pytest.fixture(scope="session")
def series() -> Series:
    """Return all series that queries can select: exported by servers or recorded by rules."""
    known = asyncio.run(exported())
    known["up"] = {"job": {job_name()}, "instance": set()}
    for rule in [*rules("benchmark.yml"), *rules("alerts.yml")]:
        if "record" in rule:
            labels = known.setdefault(rule["record"], {})
            given = {name: {value} for name, value in rule.get("labels", {}).items()}
            for name, values in (labels_of(rule["expr"], known) | given).items():
                labels.setdefault(name, set()).update(values)
    return known
