"""Consistency as tables and lines."""

import io
from collections.abc import Callable
from typing import Any

from rich.console import Console

from cab.forecast.v1 import consistency_service_pb2 as pb
from cab.forecast.v1.model_service_pb2 import ModelReference
from cab_forecast.show import print_event, print_instants, print_models, print_scene

MODEL = ModelReference(name="fan", version="1.0.0")
PART = pb.InstantConsistency(
    agent_id="[bold]",
    time=12.5,
    model=MODEL,
    errors=[
        pb.AgeError(age=0.5, displacement_error=0.1),
        pb.AgeError(age=1.0, displacement_error=0.25),
    ],
)
WHOLE = pb.InstantConsistency(
    agent_id="b",
    time=13.0,
    model=MODEL,
    complete=True,
    dispersion=pb.Dispersion(standard_deviation=0.125),
    convergence=[pb.Convergence(range=0.2, duration=0.0), pb.Convergence(range=1.0, duration=2.5)],
    errors=[pb.AgeError(age=age, displacement_error=age / 10) for age in (1.0, 3.0, 6.0)],
)
SUMS = pb.ModelConsistency(
    model=MODEL,
    instants=12345,
    dispersion_standard_deviation=pb.Summary(count=12345, mean=0.5),
    errors=[pb.AgeSummary(age=3.0, displacement_error=pb.Summary(count=1, mean=1.75))],
)


def shown(show: Callable[..., None], what: Any) -> list[str]:
    """Return the printed lines."""
    file = io.StringIO()
    show(what, console=Console(file=file))
    return file.getvalue().splitlines()


def test_observations() -> None:
    _, heading, part, whole = shown(print_instants, [PART, WHOLE])
    assert heading.split()[:4] == ["agent", "time", "model", "forecasts"]
    assert part.split() == ["[bold]", "12.50", "fan@1.0.0", "2", "ages", *"––––", "0.25", *"––"]
    assert whole.split()[3:] == ["complete", "0.12", "0.0", "2.5", "–", "0.10", "0.30", "0.60"]


def test_sums() -> None:
    _, heading, row = shown(print_models, [SUMS])
    assert heading.split()[:3] == ["model", "sets", "dispersion"]
    assert row.split() == ["fan@1.0.0", "12345", "0.50", *"–––", "–", "1.75", "–"]


def test_a_scene() -> None:
    lines = shown(print_scene, pb.GetSceneConsistencyResponse(latest=[PART], models=[SUMS]))
    assert any("[bold]" in line for line in lines)
    assert any("12345" in line for line in lines)
    assert shown(print_scene, pb.GetSceneConsistencyResponse()) == [
        "no forecast has been observed yet",
        "",
        "no forecasts are settled yet",
    ]


def test_events_are_a_line_each() -> None:
    missed, part, whole = shown(print_event, pb.WatchSceneResponse(instants=[PART, WHOLE], missed=3))
    assert missed == "3 events were missed"
    assert part == "12.50  [bold]  fan@1.0.0  2 ages  error 1 s ahead 0.25"
    assert "C(1 m) 2.5" in whole
    assert "C(5 m)" not in whole
    assert shown(print_event, pb.WatchSceneResponse()) == []
