"""Comparison with peers: ``python -m loadtest.peers [NAME …]``, or ``make peers``.

Each peer is measured beside our server, in turns. Results are added to those of earlier runs in the same
folder. The exit status is 1 if a peer did not start, a call failed or an answer differs from the forward.
"""

import asyncio
from pathlib import Path
from typing import Annotated

import typer

import model
from loadtest.peers.catalog import PEERS, interpreter
from loadtest.peers.comparison import Options, WrongAnswerError, compare
from loadtest.peers.report import Comparisons


def main(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="NAME", help=f"any of {', '.join(PEERS)}; default: all")
    ] = None,
    agents: Annotated[
        list[int] | None, typer.Option(min=1, help="vehicles a call; default: 1, 8, 32")
    ] = None,
    clients: Annotated[list[int] | None, typer.Option(min=1, help="default: 1, 16")] = None,
    seconds: Annotated[float, typer.Option(min=0, help="of each measurement")] = Options.seconds,
    engine: Annotated[str, typer.Option(help="onnxruntime or eager, for all servers")] = Options.engine,
    threads: Annotated[
        int | None, typer.Option(min=1, help="of a forward, for all servers; default: all cores")
    ] = None,
    name: Annotated[str, typer.Option("--model")] = Options.model,
    models: Annotated[
        Path | None, typer.Option(help="folder of checkpoints; default: the bundled one")
    ] = None,
    out: Annotated[Path, typer.Option(help="folder for peers.json and peers.md")] = Path("build/peers"),
) -> None:
    """Measure peers, add them to the results, and print the tables."""
    for unknown in [one for one in names or () if one not in PEERS]:
        raise typer.BadParameter(f"there is no peer {unknown}; there are {', '.join(PEERS)}")
    options = Options(
        models or Path(next(iter(model.__path__))) / "checkpoints",
        name,
        agents or Options.agents,
        clients or Options.clients,
        seconds,
        engine=engine,
        threads=threads,
    )
    comparisons, failed = Comparisons.read(out / "peers.json"), False
    for peer in names or PEERS:
        if interpreter(peer) is None:
            typer.echo(f"{peer}: skipped, {PEERS[peer].package} is not installed; see make peers", err=True)
            failed |= names is not None
            continue
        try:
            comparisons.add(asyncio.run(compare(peer, options)))
        except (WrongAnswerError, RuntimeError) as error:
            typer.echo(f"{peer}: {error}", err=True)
            failed = True
        else:
            comparisons.write(out)
    typer.echo(comparisons.markdown())
    raise typer.Exit(1 if failed else 0)


app = typer.Typer(add_completion=False)
app.command()(main)

if __name__ == "__main__":
    app()
