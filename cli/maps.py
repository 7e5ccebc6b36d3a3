# ruff: noqa: PLC0415 - imports stand in functions, so that --help does not wait for them
"""``cab-forecast map``: a scene raster from a vector map."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.failures import fail

if TYPE_CHECKING:
    from cab_forecast.maps import VectorMap


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(name="map")(map_)


def map_(
    file: Annotated[
        Path,
        typer.Argument(
            help="A map of Lanelet2 (.osm), OpenDRIVE (.xodr), nuScenes, Argoverse 2 (.json) or GeoJSON.",
        ),
    ],
    center: Annotated[
        str | None,
        typer.Option(metavar="X,Y", help="Middle of the cut, m; by default a road near the map's middle."),
    ] = None,
    size: Annotated[float, typer.Option(help="Side of the cut, m.")] = 300.0,
    pixels_per_meter: Annotated[
        float, typer.Option(help="Resolution; models look at 3 pixels per metre.")
    ] = 3.0,
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON",
            help="Origin of the ground frame, for maps in degrees; x is east and y north of it.",
        ),
    ] = None,
    map_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="nuscenes, argoverse2, lanelet2, opendrive or geojson; by default the file tells.",
        ),
    ] = None,
    layer_property: Annotated[
        str | None, typer.Option(help="GeoJSON: the property that says a feature's layer; by default layer.")
    ] = None,
    layer: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LAYER=VALUES",
            help="GeoJSON: values of that property, e.g. driveable_area=road,lane; may be repeated.",
        ),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(dir_okay=False, help="Plot the cut to a .png, .svg or .pdf file.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "--out", dir_okay=False, help="Write the cut as .binpb or .json, for predict --map."
        ),
    ] = None,
) -> None:
    """Read a map, say what it holds, and cut the raster around a position that models look at."""
    try:
        from cab_forecast.maps import read_map

        if plot is not None:
            import cab_forecast.maps.plot
        vector_map = read_map(
            file,
            map_format=map_format,  # type: ignore[arg-type]  # read_map checks it
            origin=None if origin is None else _pair(origin, "--origin"),
            layer_property=layer_property,
            layer_values=_values(layer),
        )
        middle = _pair(center, "--center") if center is not None else vector_map.anchor()
        raster = vector_map.cut(middle, size, pixels_per_meter)
        for line in _description(vector_map):
            typer.echo(line)
        typer.echo(
            f"cut:     {size:g} m around ({middle[0]:.1f}, {middle[1]:.1f}), {raster.rows} × "
            f"{raster.columns} pixels, {len(raster.image.packed_bits) / 1000:.0f} kB"
        )
        typer.echo(f"digest:  {raster.digest.hex()}")
        if output is not None:
            from cli.messages import write_message

            write_message(output, raster)
        if plot is not None:
            cab_forecast.maps.plot.plot_map(raster, plot, file.name)
    except (OSError, ValueError, ModuleNotFoundError) as error:
        fail(str(error))


def _description(vector_map: "VectorMap") -> list[str]:
    counts = vector_map.counts
    found = ", ".join(f"{name.replace('_', ' ')} {count}" for name, count in counts.items())
    lines = [f"layers:  {found}", f"extent:  {vector_map.extent}"]
    absent = [name.replace("_", " ") for name, count in counts.items() if not count]
    notes = [f"no {name}: models see none" for name in absent] + list(vector_map.notes)
    return lines + [f"note:    {note}" for note in notes]


def _pair(text: str, option: str) -> tuple[float, float]:
    try:
        first, second = map(float, text.split(","))
    except ValueError as error:
        raise ValueError(f"{option} takes two numbers with a comma between them, not {text!r}") from error
    return first, second


def _values(layers: list[str] | None) -> dict[str, list[str]] | None:
    if layers is None:
        return None
    values: dict[str, list[str]] = {}
    for text in layers:
        name, equals, named = text.partition("=")
        if not equals:
            raise ValueError(f"--layer takes LAYER=VALUE,VALUE, not {text!r}")
        values.setdefault(name, []).extend(named.split(","))
    return values
