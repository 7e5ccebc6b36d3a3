"""Map files: their format, and the reader of each."""

import json
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Final, Literal, get_args

from cab_forecast.maps.projection import Origin
from cab_forecast.maps.readers import argoverse2, geojson, lanelet2, nuscenes, opendrive
from cab_forecast.maps.vector_map import MapError, VectorMap

Format = Literal["nuscenes", "argoverse2", "lanelet2", "opendrive", "geojson"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)
_SUFFIXES: Final[Mapping[str, Format]] = {".osm": "lanelet2", ".xodr": "opendrive", ".geojson": "geojson"}
_KEYS: Final[Mapping[str, Format]] = {
    "drivable_areas": "argoverse2",
    "drivable_area": "nuscenes",
    "features": "geojson",
}
"""A key of the JSON object of each format that the others do not have."""


def read_map(
    path: str | PathLike[str],
    *,
    map_format: Format | None = None,
    origin: Origin | None = None,
    layer_property: str | None = None,
    layer_values: Mapping[str, Sequence[str]] | None = None,
) -> VectorMap:
    """Read a map file.

    Args:
        path: the file.
        map_format: its format, see ``FORMATS``; None: told by its suffix, or the keys of its JSON.
        origin: latitude and longitude, degrees, of the ground frame's origin, for Lanelet2 and for GeoJSON in
            degrees; x is then east and y north, in UTM.
        layer_property: for GeoJSON: the property that says a feature's layer; None: ``layer``.
        layer_values: for GeoJSON: values of that property by layer; None: the names of the layers.

    Raises:
        OSError: the file cannot be read.
        MapError: it is no such map, it holds no driveable area, an argument does not fit its format, or it is
            in degrees and there is no origin.
        ModuleNotFoundError: the library that reads the format is not installed.
    """
    file = Path(path)
    if map_format is not None and map_format not in FORMATS:
        raise MapError(f"formats of maps are {', '.join(FORMATS)}, not {map_format!r}")
    kind = map_format or _SUFFIXES.get(file.suffix.lower())
    content: Any = None
    if kind not in ("lanelet2", "opendrive"):
        content = _json_object(file)
        kind = kind or _told_by_keys(file, content)
    if origin is not None and kind not in ("lanelet2", "geojson"):
        raise MapError(f"{file.name} is a map of {kind}, which is in metres: leave the origin out")
    if kind != "geojson" and (layer_property is not None or layer_values is not None):
        raise MapError(f"{file.name} is a map of {kind}: only those in GeoJSON are told where layers are")
    if kind == "lanelet2":
        return lanelet2.read(file, origin)
    if kind == "opendrive":
        return opendrive.read(file)
    try:
        if kind == "nuscenes":
            return nuscenes.read(content, file.name)
        if kind == "argoverse2":
            return argoverse2.read(content, file.name)
        return geojson.read(content, file.name, origin, layer_property or "layer", layer_values)
    except (KeyError, TypeError, AttributeError) as error:
        raise MapError(f"{file.name} is no map of {kind}: {error!r} where its parts are looked up") from error


def _json_object(file: Path) -> dict[str, Any]:
    try:
        content = json.loads(file.read_bytes())
    except ValueError as error:
        raise MapError(
            f"{file.name} is no map: it is neither JSON ({error}), nor named .osm (Lanelet2) or "
            ".xodr (OpenDRIVE)"
        ) from error
    if not isinstance(content, dict):
        raise MapError(f"{file.name} is no map: its JSON is no object")
    return content


def _told_by_keys(file: Path, content: Mapping[str, Any]) -> Format:
    for key, kind in _KEYS.items():
        if key in content:
            return kind
    raise MapError(
        f"{file.name} is no map that is known: its JSON has none of the keys {', '.join(_KEYS)}, which tell "
        f"formats apart. Formats are {', '.join(FORMATS)}"
    )
