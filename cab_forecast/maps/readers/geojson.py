"""GeoJSON (RFC 7946): a FeatureCollection whose features name their layer in a property."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import shapely
from shapely.geometry import shape

from cab_forecast.maps.projection import Origin, UtmProjection
from cab_forecast.maps.vector_map import LAYERS, MapError, VectorMap

_NAMES: Mapping[str, Sequence[str]] = {
    "driveable_area": ("driveable_area", "drivable_area"),
    "road_dividers": ("road_dividers", "road_divider"),
    "lane_dividers": ("lane_dividers", "lane_divider"),
}
"""Values of the property that name each layer."""


def read(
    content: Mapping[str, Any],
    source: str,
    origin: Origin | None,
    layer_property: str,
    layer_values: Mapping[str, Sequence[str]] | None,
) -> VectorMap:
    """Read a FeatureCollection.

    Args:
        content: the JSON object.
        source: what errors call it.
        origin: of coordinates in degrees, see ``cab_forecast.maps.read_map``; None: they are metres.
        layer_property: the property that says a feature's layer.
        layer_values: its values by layer; None: the names of the layers.

    Raises:
        MapError: it is no FeatureCollection, no feature is of the driveable area, a geometry is malformed, or
            the coordinates are degrees and there is no origin.
    """
    if content.get("type") != "FeatureCollection":
        raise MapError(f"{source} is no GeoJSON FeatureCollection: its type is {content.get('type')!r}")
    values = _NAMES if layer_values is None else layer_values
    unknown = [layer for layer in values if layer not in LAYERS]
    if unknown:
        raise MapError(f"there is no layer {unknown[0]!r}: layers are {', '.join(LAYERS)}")
    layer_of = {value: layer for layer, named in values.items() for value in named}
    shapes: dict[str, list[Any]] = {layer: [] for layer in LAYERS}
    left_out: Counter[str] = Counter()
    for number, feature in enumerate(content["features"]):
        value = (feature.get("properties") or {}).get(layer_property)
        layer = layer_of.get(str(value))
        if layer is None:
            left_out[str(value)] += 1
        elif feature["geometry"] is not None:
            shapes[layer].append(_geometry(feature["geometry"], f"features[{number}] of {source}"))
    if not shapes[LAYERS[0]]:
        wanted = ", ".join(values.get(LAYERS[0], ())) or "nothing"
        found = ", ".join(sorted({*left_out} - {"None"})[:12]) or "nothing"
        raise MapError(
            f"no feature of {source} is of the driveable area: the property {layer_property!r} should be "
            f"{wanted}, and is {found}. Say which property names the layer, and which of its values mean "
            "which layer: layer_property and layer_values (--layer-property and --layer on the command line)"
        )
    if origin is not None:
        project = UtmProjection(origin)
        shapes = {
            layer: [shapely.transform(shapely.force_2d(one), project) for one in every]
            for layer, every in shapes.items()
        }
    notes = [
        f"left out {count} features whose {layer_property} is {value}" for value, count in left_out.items()
    ]
    return VectorMap(shapes, source=source, notes=notes)


def _geometry(geometry: Mapping[str, Any], where: str) -> Any:
    try:
        return shape(geometry)
    except (
        ValueError,
        TypeError,
        KeyError,
        IndexError,
        AttributeError,
        shapely.errors.ShapelyError,
    ) as error:
        raise MapError(f"the geometry of {where} is malformed: {error}") from error
