"""A table of every case's readings: ``python -m tests.cases.report --model cab`` or ``--checkpoint DIR``."""

import argparse
import logging
import math
import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import structlog
from rich.console import Console
from rich.table import Table

from tests.cases import checks, driving, given, scenes
from tests.cases.bands import Reading, few_modes, readings, widths
from tests.cases.case import Case, Pose, Scenario, View
from tests.cases.running import Served, bundled, from_checkpoint

_TURNS = (0.5 * math.pi, 2.3, -1.1)
"""rad by which scenes are rotated."""
TURNED_WITHIN: dict[View, float] = {"none": 0.01, "patch": 0.01, "raster": 0.5}
"""Max distance between the forecasts of rotated scenes, m, by view of the map."""
_TURNED = ("standing", "straight 9", "curve 62", "junction in 22 m", "lead in 24 m")


def judged(cases: Sequence[Case], served: Served) -> list[tuple[Case, list[Reading]]]:
    """Return all readings of each case."""
    found = served.answer(cases)
    by_name = {case.name: forecast for case, forecast in zip(cases, found, strict=True)}
    name = served.info.name
    return [
        (
            case,
            [
                *readings(case, forecast, by_name.get(case.facts.companion), name),
                *widths(forecast),
                *few_modes(forecast),
            ],
        )
        for case, forecast in zip(cases, found, strict=True)
    ]


def turned(scenarios: Iterable[Scenario], served: Served) -> list[tuple[str, list[Reading]]]:
    """Return the distances between forecasts of rotated and shifted scenes, each in the scene's own frame."""
    table = []
    for scenario in scenarios:
        poses = [Pose(), *(Pose(150.0 * turn, -80.0, turn) for turn in _TURNS)]
        rows = []
        for view, limit in TURNED_WITHIN.items():
            found = served.answer([scenario.at(pose).case(view) for pose in poses])
            gap = max(checks.apart(found[0], other) for other in found[1:])
            rows.append(Reading(f"turned, map as {view}: any mode", gap, high=limit))
            ends = np.stack([other.likeliest[-1] - found[0].likeliest[-1] for other in found[1:]])
            rows.append(Reading(f"turned, map as {view}: ML end", np.linalg.norm(ends, axis=-1).max()))
        table.append((f"{scenario.name}, turned", rows))
    return table


def steady(served: Served) -> list[tuple[str, list[Reading]]]:
    """Return the jumps of the most likely end from tick to tick."""
    return [
        (drive.name, drive.readings(served.answer([one.case() for one in drive.ticks])))
        for drive in driving.drives()
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the number of readings outside their bands."""
    parser = argparse.ArgumentParser(prog="python -m tests.cases.report", description=__doc__)
    model = parser.add_mutually_exclusive_group()
    model.add_argument("--model", default="cab", help="a bundled model, name or name@version")
    model.add_argument("--checkpoint", type=Path, help="a checkpoint's folder, instead of a bundled model")
    parser.add_argument("--shared", type=Path, help="folder of the shared cases")
    parser.add_argument("--only", default="", help="only cases whose name or row contains this")
    parser.add_argument("--failures", action="store_true", help="print only readings outside their bands")
    parser.add_argument("--no-series", action="store_true", help="leave out rotated scenes and drives")
    chosen = parser.parse_args(arguments)

    started = time.perf_counter()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING))
    forecaster = from_checkpoint(chosen.checkpoint) if chosen.checkpoint else bundled(chosen.model)
    scenarios = scenes.all_rows()
    cases = [scenario.case() for scenario in scenes.at_poses(scenarios)]
    folder = chosen.shared or _shared_cases()
    if folder.is_dir():
        cases += given.read_cases(folder)
    with Served(forecaster) as served:
        results = [(f"{case.name} [{case.row}]", rows) for case, rows in judged(cases, served)]
        if not chosen.no_series:
            results += turned([one for one in scenarios if one.name in _TURNED], served)
            results += steady(served)
    results = [(name, rows) for name, rows in results if chosen.only in name]
    console = Console(width=None if os.isatty(1) else 120)
    console.print(_table(forecaster.info.full_name, results, chosen.failures))
    all_judged = [one for _, rows in results for one in rows if one.judged]
    wrong = sum(not one.ok for one in all_judged)
    whole = sum(all(one.ok for one in rows if one.judged) for _, rows in results)
    console.print(
        f"{len(all_judged) - wrong} of {len(all_judged)} readings are within their bands; "
        f"{whole} of {len(results)} cases have all of theirs ({time.perf_counter() - started:.0f} s)"
    )
    return wrong


def _table(title: str, results: Sequence[tuple[str, Sequence[Reading]]], failures: bool) -> Table:
    table = Table(title=title, title_justify="left", box=None, padding=(0, 2, 0, 0))
    for column in ("case", "what"):
        table.add_column(column, no_wrap=True)
    table.add_column("value", justify="right")
    table.add_column("band")
    table.add_column("")
    for name, rows in results:
        label = name
        for one in rows:
            if failures and one.ok:
                continue
            verdict = ("[green]PASS[/]" if one.ok else "[bold red]FAIL[/]") if one.judged else ""
            table.add_row(label.replace("[", r"\["), one.what, f"{one.value:.3g}", one.band, verdict)
            label = ""
    return table


def _shared_cases() -> Path:
    beside = Path(__file__).resolve().parents[2].parent / "shared"
    return Path(os.environ.get("CAB_FORECAST_SHARED", beside)) / "cases"


if __name__ == "__main__":
    raise SystemExit(min(main(), 1))
