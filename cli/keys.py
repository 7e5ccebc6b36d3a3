# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for them
"""``cab-forecast keys``: the file of API keys that a server reads."""

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.failures import fail

if TYPE_CHECKING:
    from service.access.key_file import Key

File = Annotated[
    Path,
    typer.Option("--file", dir_okay=False, envvar="FORECAST_KEYS_FILE", help="File of keys of the server."),
]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the holder, for logs and metrics.")]


class Scope(StrEnum):
    """Scopes of ``service.access.scopes``, which is slow to import; a test compares the two."""

    PREDICT = "predict"
    READ = "read"
    RESET = "reset"
    METRICS = "metrics"
    ADMIN = "admin"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = typer.Typer(
        help="Make, list and remove the API keys of a server, which reads the changed file within seconds.",
        no_args_is_help=True,
    )
    group.command("add")(add)
    group.command("list")(list_keys)
    group.command("remove")(remove)
    app.add_typer(group, name="keys")


def add(
    name: Name,
    file: File,
    *,
    scope: Annotated[
        list[Scope] | None,
        typer.Option(help="Right of the key; give the option once for each. [default: predict]"),
    ] = None,
    agents_per_second: Annotated[
        float | None, typer.Option(help="Max rate of agents in its requests. [default: no limit]")
    ] = None,
    concurrent_agents: Annotated[
        int | None, typer.Option(help="Max agents in its requests in progress. [default: no limit]")
    ] = None,
    streams: Annotated[
        int | None, typer.Option(help="Max streams of events at a time. [default: no limit]")
    ] = None,
) -> None:
    """Make a key and print it, once; the file holds its hash alone. The file is created if it is missing."""
    from service.access import key_file
    from service.access.scopes import Scope as KeyScope

    with _failing():
        keys = key_file.read_keys(file) if file.exists() else ()
        if any(key.name == name for key in keys):
            fail(f"{file} has a key for {name} already; remove it first, or choose another name")
        text, entry = key_file.new_key(
            name,
            sorted({KeyScope(each.value) for each in scope or [Scope.PREDICT]}),
            agents_per_second=agents_per_second,
            concurrent_agents=concurrent_agents,
            streams=streams,
        )
        key_file.write_keys(file, [*keys, entry])
    typer.echo(text)
    typer.echo(f"{_describe(entry)}; keep the key, it is shown only now", err=True)


def list_keys(file: File) -> None:
    """Show the holders of keys, their scopes and limits."""
    from service.access.key_file import read_keys

    with _failing():
        keys = read_keys(file)
    for key in keys:
        typer.echo(_describe(key))


def remove(name: Name, file: File) -> None:
    """Remove a key: the server refuses it, and ends its streams, within seconds."""
    from service.access.key_file import read_keys, write_keys

    with _failing():
        keys = read_keys(file)
        if all(key.name != name for key in keys):
            fail(f"{file} has no key for {name}")
        write_keys(file, [key for key in keys if key.name != name])


@contextmanager
def _failing() -> Iterator[None]:
    """Turn errors of the file into one line on standard error."""
    from service.access.key_file import KeyFileError

    try:
        yield
    except KeyFileError as error:
        fail(str(error))


def _describe(key: "Key") -> str:
    limits = {
        "agents/s": key.agents_per_second,
        "agents at a time": key.concurrent_agents,
        "streams": key.streams,
    }
    texts = [f"at most {value:g} {unit}" for unit, value in limits.items() if value is not None]
    return f"{key.name}: {', '.join([*key.scopes, *texts]) or 'no scopes'}"
