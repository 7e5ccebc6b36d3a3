"""``cab-forecast doctor``: check what a server needs before it is started."""

import json
from pathlib import Path
from typing import Annotated

import typer

_COLORS = {"OK": typer.colors.GREEN, "WARN": typer.colors.YELLOW, "FAIL": typer.colors.RED}


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("doctor")(doctor)


def doctor(
    config: Annotated[
        Path | None, typer.Option(help="TOML file of settings. [default: $FORECAST_CONFIG]")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
) -> None:
    """Check settings, models, Redis, ports and threads of a server, before it is started.

    It reads the settings as `serve` does, from the environment and the file. Each line is OK, WARN or FAIL;
    the exit code is 1 if one is FAIL. Run it where no server is running: its ports would be taken.
    """
    from service.doctor import Finding, Level, examine  # noqa: PLC0415 (slow to import)
    from service.settings import SettingsError, load  # noqa: PLC0415
    from service.telemetry import logs  # noqa: PLC0415

    logs.configure("error", as_json=False)  # the findings tell what a server would log
    failed = False
    shown = []
    try:
        settings = load(config)
        findings = iter([Finding("settings", Level.OK, "valid")])
    except SettingsError as error:
        findings, settings = iter([Finding("settings", Level.FAIL, str(error))]), None
    for part in (findings, [] if settings is None else examine(settings)):
        for finding in part:
            failed |= finding.level is Level.FAIL
            shown.append({"check": finding.check, "level": finding.level.value, "text": finding.text})
            if not as_json:
                level = typer.style(f"{finding.level.value:4}", fg=_COLORS[finding.level.value])
                typer.echo(f"{level} {finding.check}: {finding.text}")
    if as_json:
        typer.echo(json.dumps(shown, indent=2, ensure_ascii=False))
    if failed:
        raise typer.Exit(1)
